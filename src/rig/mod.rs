//! Cameras and rigs of N cameras, three-view rectification.

pub mod calibrate;
pub mod camera;
pub mod lens;
pub mod rectify;

pub use camera::Camera;
pub use lens::Lens;

use nalgebra::{Matrix3, Rotation3, Vector3};

/// Which axis of the world points up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Up {
    Y,
    #[default]
    Z,
}

impl Up {
    /// The up direction as a unit vector of the world.
    pub fn direction(self) -> Vector3<f64> {
        match self {
            Up::Y => Vector3::y(),
            Up::Z => Vector3::z(),
        }
    }
}

/// Synchronized, calibrated cameras in one world.
#[derive(Clone, Debug, PartialEq)]
pub struct Rig {
    pub cameras: Vec<Camera>,
    pub up: Up,
}

/// Real rigs hardly reach across 10 m; one written in millimetres always does.
const LONGEST_BASELINE_M: f64 = 10.0;
/// Two lenses do not fit into 1 mm.
const SHORTEST_BASELINE_M: f64 = 1e-3;
/// Beyond this angle between optical axes, correlation windows see different sides of a person.
const WIDEST_STEREO_ANGLE_DEG: f64 = 45.0;

/// What makes a rig unusable.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RigError {
    #[error("the rig has no camera")]
    NoCameras,
    #[error("the camera name {name:?} cannot be the name of a file; use letters, digits, _ and -")]
    Name { name: String },
    #[error("two cameras are called {name}; give each a name of its own")]
    SameName { name: String },
    #[error("{camera}: {what} holds a number that is not finite; calibrate this camera again")]
    NotFinite { camera: String, what: &'static str },
    #[error("{camera}: the image size {width}x{height} px is impossible; write the size of the pictures in pixels")]
    Size { camera: String, width: u32, height: u32 },
    #[error("{camera}: the camera matrix must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]]")]
    MatrixForm { camera: String },
    #[error(
        "{camera}: a focal length of {fx_px:.1} x {fy_px:.1} px does not fit pictures of {width}x{height} px; was it calibrated at another size or in mm?"
    )]
    Focal { camera: String, fx_px: f64, fy_px: f64, width: u32, height: u32 },
    #[error(
        "{camera}: the principal point ({cx_px:.1}, {cy_px:.1}) px lies outside the pictures of {width}x{height} px; was it calibrated at another size?"
    )]
    PrincipalPoint { camera: String, cx_px: f64, cy_px: f64, width: u32, height: u32 },
    #[error("{camera}: the rotation is not orthonormal; write it as a Rodrigues vector in radians")]
    Rotation { camera: String },
    #[error(
        "{first} and {second} are {baseline_m:.1} m apart, which looks like millimetres; divide all translations by 1000 (muybridge rig convert FILE --scale 0.001 -o Calib.toml)"
    )]
    LooksLikeMillimetres { first: String, second: String, baseline_m: f64 },
    #[error(
        "no two cameras are further apart than {baseline_m:.2e} m, which looks like kilometres; multiply all translations by 1000 (muybridge rig convert FILE --scale 1000 -o Calib.toml)"
    )]
    LooksLikeKilometres { baseline_m: f64 },
    #[error("{first} and {second} stand in the same place; one of them has the other's translation")]
    SamePlace { first: String, second: String },
    #[error("stereo needs at least two cameras, the rig has {0}")]
    TooFewForStereo(usize),
    #[error(
        "{first} and {second} look {angle_deg:.0} degrees apart; correlation stereo needs cameras side by side, within {WIDEST_STEREO_ANGLE_DEG} degrees"
    )]
    ViewsApart { first: String, second: String, angle_deg: f64 },
}

/// Names of files end at 255 bytes; ours have something before and behind the camera's.
const LONGEST_NAME: usize = 100;

/// Whether a camera's name is one visible file name wherever it is put, and never a way out of a folder.
pub fn is_file_name(name: &str) -> bool {
    let hidden = name.is_empty() || name.starts_with('.');
    !hidden && name.len() <= LONGEST_NAME && !name.contains(|c: char| c.is_control() || matches!(c, '/' | '\\' | ':'))
}

impl Rig {
    /// Distances between camera centres, metres, as (camera, later camera, distance).
    pub fn baselines_m(&self) -> Vec<(usize, usize, f64)> {
        let centres: Vec<_> = self.cameras.iter().map(Camera::centre).collect();
        pairs(centres.len()).map(|(i, k)| (i, k, (centres[i] - centres[k]).norm())).collect()
    }

    /// Refuses cameras and units that no real rig has.
    pub fn validate(&self) -> Result<(), RigError> {
        if self.cameras.is_empty() {
            return Err(RigError::NoCameras);
        }
        self.validate_names()?;
        self.cameras.iter().try_for_each(validate_camera)?;
        let baselines = self.baselines_m();
        let name = |i: usize| self.cameras[i].name.clone();
        let longest = baselines.iter().map(|b| b.2).fold(0.0, f64::max);
        if let Some(&(i, k, baseline_m)) = baselines.iter().find(|b| b.2 > LONGEST_BASELINE_M) {
            return Err(RigError::LooksLikeMillimetres { first: name(i), second: name(k), baseline_m });
        }
        if longest > 0.0 && longest < SHORTEST_BASELINE_M {
            return Err(RigError::LooksLikeKilometres { baseline_m: longest });
        }
        match baselines.iter().find(|b| b.2 < SHORTEST_BASELINE_M) {
            Some(&(i, k, _)) => Err(RigError::SamePlace { first: name(i), second: name(k) }),
            None => Ok(()),
        }
    }

    /// Folders, pictures and keys are named after cameras, and the names come from files.
    fn validate_names(&self) -> Result<(), RigError> {
        for (i, Camera { name, .. }) in self.cameras.iter().enumerate() {
            if !is_file_name(name) {
                return Err(RigError::Name { name: name.chars().take(LONGEST_NAME).collect() });
            }
            if self.cameras[..i].iter().any(|c| c.name == *name) {
                return Err(RigError::SameName { name: name.clone() });
            }
        }
        Ok(())
    }

    /// The same rig in another world: upright as the first camera stands, x to its right, horizontally away from it along y
    /// (z-up) or along -z (y-up), zero `height_m` below its centre. For rigs whose world says nothing about up.
    pub fn upright_at_first_camera(&self, up: Up, height_m: f64) -> Rig {
        let Some(first) = self.cameras.first() else { return self.clone() };
        let camera_from_upright = match up {
            Up::Z => Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0),
            Up::Y => Matrix3::new(1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0),
        };
        let world_from_upright = first.camera_from_world.inverse() * Rotation3::from_matrix_unchecked(camera_from_upright);
        let zero_in_world = first.centre() - world_from_upright * up.direction() * height_m;
        let cameras = self.cameras.iter().map(|c| Camera {
            camera_from_world: c.camera_from_world * world_from_upright,
            translation: c.camera_point(&zero_in_world),
            ..c.clone()
        });
        Rig { cameras: cameras.collect(), up }
    }

    /// Refuses rigs that correlation stereo cannot serve: fewer than two cameras, or views from different sides.
    pub fn validate_stereo(&self) -> Result<(), RigError> {
        if self.cameras.len() < 2 {
            return Err(RigError::TooFewForStereo(self.cameras.len()));
        }
        let axes: Vec<_> = self.cameras.iter().map(|c| c.camera_from_world.inverse() * Vector3::z()).collect();
        for (i, k) in pairs(axes.len()) {
            let angle_deg = axes[i].angle(&axes[k]).to_degrees();
            if angle_deg > WIDEST_STEREO_ANGLE_DEG {
                let (first, second) = (self.cameras[i].name.clone(), self.cameras[k].name.clone());
                return Err(RigError::ViewsApart { first, second, angle_deg });
            }
        }
        Ok(())
    }
}

fn pairs(count: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..count).flat_map(move |i| (i + 1..count).map(move |k| (i, k)))
}

fn validate_camera(c: &Camera) -> Result<(), RigError> {
    let camera = c.name.clone();
    let finite: [(&'static str, &[f64]); 4] = [
        ("the camera matrix", c.matrix.as_slice()),
        ("the distortion", c.lens.terms()),
        ("the rotation", c.camera_from_world.matrix().as_slice()),
        ("the translation", c.translation.as_slice()),
    ];
    if let Some(&(what, _)) = finite.iter().find(|(_, numbers)| numbers.iter().any(|x| !x.is_finite())) {
        return Err(RigError::NotFinite { camera, what });
    }
    let [width, height] = c.size_px;
    if width.min(height) < 8 || width.max(height) > 100_000 {
        return Err(RigError::Size { camera, width, height });
    }
    validate_matrix(c)?;
    let r = c.camera_from_world.matrix();
    if (r * r.transpose() - Matrix3::identity()).norm() > 1e-6 || r.determinant() < 0.0 {
        return Err(RigError::Rotation { camera });
    }
    Ok(())
}

fn validate_matrix(c: &Camera) -> Result<(), RigError> {
    let (camera, [width, height], m) = (c.name.clone(), c.size_px, &c.matrix);
    if m[(1, 0)] != 0.0 || m[(2, 0)] != 0.0 || m[(2, 1)] != 0.0 || m[(2, 2)] != 1.0 {
        return Err(RigError::MatrixForm { camera });
    }
    let (fx_px, fy_px, longer) = (m[(0, 0)], m[(1, 1)], f64::from(width.max(height)));
    let plausible = |f: f64| f > 0.2 * longer && f < 30.0 * longer;
    if !plausible(fx_px) || !plausible(fy_px) || !(0.5..2.0).contains(&(fx_px / fy_px)) {
        return Err(RigError::Focal { camera, fx_px, fy_px, width, height });
    }
    let (cx_px, cy_px) = (m[(0, 2)], m[(1, 2)]);
    if !(0.0..f64::from(width)).contains(&cx_px) || !(0.0..f64::from(height)).contains(&cy_px) {
        return Err(RigError::PrincipalPoint { camera, cx_px, cy_px, width, height });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rig() -> Rig {
        let camera = |name: &str, x: f64, z: f64| {
            let camera_from_world = Rotation3::from_scaled_axis(Vector3::x() * std::f64::consts::FRAC_PI_2);
            Camera {
                name: name.into(),
                size_px: [640, 480],
                matrix: Matrix3::new(550.0, 0.0, 320.0, 0.0, 550.0, 240.0, 0.0, 0.0, 1.0),
                lens: Lens::IDEAL,
                camera_from_world,
                translation: -(camera_from_world * Vector3::new(x, 0.0, z)),
            }
        };
        Rig { cameras: vec![camera("cam_00", 0.0, 1.0), camera("cam_01", 0.3, 1.0), camera("cam_02", 0.0, 1.4)], up: Up::Z }
    }

    fn scaled(factor: f64) -> Rig {
        let mut rig = rig();
        rig.cameras.iter_mut().for_each(|c| c.translation *= factor);
        rig
    }

    fn changed(change: impl Fn(&mut Camera)) -> Result<(), RigError> {
        let mut rig = rig();
        change(&mut rig.cameras[1]);
        rig.validate()
    }

    #[test]
    fn baselines_are_the_distances_of_the_centres() {
        let expected = [(0, 1, 0.3), (0, 2, 0.4), (1, 2, 0.5)];
        for (found, expected) in rig().baselines_m().into_iter().zip(expected) {
            assert_eq!((found.0, found.1), (expected.0, expected.1));
            assert!((found.2 - expected.2).abs() < 1e-12);
        }
        assert_eq!(rig().validate(), Ok(()));
        assert_eq!(rig().validate_stereo(), Ok(()));
    }

    #[test]
    fn wrong_units_are_refused_with_the_remedy() {
        let millimetres = scaled(1000.0).validate().unwrap_err();
        assert!(millimetres.to_string().contains("300.0 m apart, which looks like millimetres; divide"), "{millimetres}");
        let kilometres = scaled(1e-3).validate().unwrap_err();
        assert!(matches!(kilometres, RigError::LooksLikeKilometres { baseline_m } if (baseline_m - 5e-4).abs() < 1e-9));
        assert_eq!(scaled(10.0).validate(), Ok(()));
    }

    #[test]
    fn impossible_cameras_are_refused() {
        assert!(matches!(changed(|c| c.translation = Vector3::new(0.0, 1.0, 0.0)), Err(RigError::SamePlace { .. })));
        assert!(matches!(
            changed(|c| c.lens = Lens::Fisheye([0.0, f64::NAN, 0.0, 0.0])),
            Err(RigError::NotFinite { what: "the distortion", .. })
        ));
        assert!(matches!(changed(|c| c.size_px = [0, 480]), Err(RigError::Size { .. })));
        assert!(matches!(changed(|c| c.matrix[(0, 0)] = 3.6), Err(RigError::Focal { .. })));
        assert!(matches!(changed(|c| c.size_px = [320, 240]), Err(RigError::PrincipalPoint { .. })));
        assert!(matches!(changed(|c| c.matrix[(2, 2)] = 0.0), Err(RigError::MatrixForm { .. })));
        let sheared = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0));
        assert!(matches!(changed(|c| c.camera_from_world = sheared), Err(RigError::Rotation { .. })));
        assert_eq!(Rig { cameras: vec![], up: Up::Z }.validate(), Err(RigError::NoCameras));
    }

    #[test]
    fn an_upright_world_moves_no_camera_against_another() {
        let rig = rig();
        for up in [Up::Y, Up::Z] {
            let upright = rig.upright_at_first_camera(up, 1.3);
            assert_eq!(upright.validate(), Ok(()));
            for (a, b) in upright.baselines_m().iter().zip(rig.baselines_m()) {
                assert!((a.2 - b.2).abs() < 1e-12);
            }
            assert!((upright.cameras[0].centre() - up.direction() * 1.3).norm() < 1e-12);
            // The third camera is 0.4 m above the first, the second 0.3 m to its right; all look along +y of the old world.
            assert!((upright.cameras[2].centre() - up.direction() * 1.7).norm() < 1e-12);
            assert!((upright.cameras[1].centre() - up.direction() * 1.3 - Vector3::x() * 0.3).norm() < 1e-12);
            let forward = upright.cameras[1].camera_from_world.inverse() * Vector3::z();
            let expected = if up == Up::Z { Vector3::y() } else { -Vector3::z() };
            assert!((forward - expected).norm() < 1e-12);
        }
    }

    #[test]
    fn stereo_needs_two_cameras_that_look_the_same_way() {
        let mut turned = rig();
        turned.cameras[2].camera_from_world *= Rotation3::from_scaled_axis(Vector3::z() * 60f64.to_radians());
        let error = turned.validate_stereo().unwrap_err();
        assert!(matches!(error, RigError::ViewsApart { angle_deg, .. } if (angle_deg - 60.0).abs() < 1e-9), "{error}");
        let alone = Rig { cameras: rig().cameras[..1].to_vec(), up: Up::Z };
        assert_eq!(alone.validate(), Ok(()));
        assert_eq!(alone.validate_stereo(), Err(RigError::TooFewForStereo(1)));
    }
}
