//! Footage for calibration: per camera a folder or glob of pictures, or a video.
//!
//! Pictures are numbered by the last digits in their names, video frames from 0; simultaneous ones have the same number.
//! Cameras need not have the same numbers. Symbolic links are followed.

use super::images::{ImageError, read_grey};
use super::session::{self, SessionError};
use super::video::{self, Video, VideoError};
use image::GrayImage;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Why footage cannot be used; every message names the file.
#[derive(Debug, thiserror::Error)]
pub enum ViewsError {
    #[error(transparent)]
    Session(#[from] SessionError),
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Video(#[from] VideoError),
    #[error("{}: is a single picture; give one folder, one video or one glob in quotes ('left*.png') per camera", path.display())]
    SinglePicture { path: PathBuf },
    #[error("{}: is no folder, no video and no glob; give one of them per camera", path.display())]
    NoFootage { path: PathBuf },
    #[error("{}: is given for two cameras", path.display())]
    Twice { path: PathBuf },
    #[error("{}: frame {number} is {width}x{height} px, the frames before are {}x{}; one camera has one size", path.display(), before[0], before[1])]
    Size { path: PathBuf, number: usize, width: u32, height: u32, before: [u32; 2] },
}

/// Footage of one camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraViews {
    pub name: String,
    pub source: ViewSource,
}

#[derive(Clone, Debug, PartialEq)]
pub enum ViewSource {
    /// By ascending number.
    Pictures(Vec<(usize, PathBuf)>),
    Video(PathBuf),
}

/// Opens the footage of all cameras; they are called by the last parts of their paths that differ.
pub fn open(paths: &[PathBuf]) -> Result<Vec<CameraViews>, ViewsError> {
    let names = distinct_names(paths)?;
    let camera = |(path, name): (&PathBuf, String)| Ok(CameraViews { name, source: source(path)? });
    paths.iter().zip(names).map(camera).collect()
}

fn source(path: &Path) -> Result<ViewSource, ViewsError> {
    if path.is_dir() {
        return Ok(ViewSource::Pictures(session::numbered_images(path)?));
    }
    if video::is_video_name(path) && path.exists() {
        return Ok(ViewSource::Video(path.into()));
    }
    let pattern = session::file_name(path);
    if pattern.contains(['*', '?']) {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let files = session::list(folder)?.into_iter().filter(|file| matches(pattern.as_bytes(), session::file_name(file).as_bytes()));
        return Ok(ViewSource::Pictures(session::numbered(path, files.collect())?));
    }
    let path = path.to_path_buf();
    Err(if path.is_file() { ViewsError::SinglePicture { path } } else { ViewsError::NoFootage { path } })
}

/// Whether `*` (any characters) and `?` (any one) of the pattern fit the name.
fn matches(pattern: &[u8], name: &[u8]) -> bool {
    match (pattern.split_first(), name.split_first()) {
        (None, None) => true,
        (Some((b'*', rest)), _) => matches(rest, name) || name.split_first().is_some_and(|(_, after)| matches(pattern, after)),
        (Some((p, rest)), Some((n, after))) => (*p == b'?' || p == n) && matches(rest, after),
        _ => false,
    }
}

/// The last parts of the paths in which all cameras differ: a folder's name, a video's without its ending, what stands before
/// a glob's first wildcard, or a folder above.
fn distinct_names(paths: &[PathBuf]) -> Result<Vec<String>, ViewsError> {
    let parts: Vec<Vec<String>> = paths.iter().map(|path| name_parts(path)).collect();
    let deepest = parts.iter().map(Vec::len).max().unwrap_or(0);
    for depth in 0..deepest {
        let names: Vec<String> = parts.iter().map(|p| p.get(depth).cloned().unwrap_or_default()).collect();
        if names.iter().all(|n| !n.is_empty()) && names.iter().collect::<BTreeSet<_>>().len() == names.len() {
            return Ok(names);
        }
    }
    let twice = paths.iter().enumerate().find(|(k, path)| paths[..*k].contains(path)).map_or(&paths[0], |(_, path)| path);
    Err(ViewsError::Twice { path: twice.clone() })
}

/// Possible names of a camera, the best first.
fn name_parts(path: &Path) -> Vec<String> {
    let whole = std::path::absolute(path).unwrap_or_else(|_| path.into());
    let last = session::file_name(&whole);
    let own = match last.find(['*', '?']) {
        Some(wildcard) => last[..wildcard].trim_end_matches(['_', '-', '.', ' ']).to_string(),
        None if whole.is_dir() => last,
        None => session::stem(&whole),
    };
    let own = Some(own).filter(|name| !name.is_empty());
    own.into_iter().chain(whole.ancestors().skip(1).map(session::file_name).filter(|name| !name.is_empty())).collect()
}

impl CameraViews {
    /// Number of pictures of which every `every`-th number is taken, or of a video's frames, by its header.
    pub fn count(&self, every: usize) -> usize {
        match &self.source {
            ViewSource::Pictures(files) => files.iter().filter(|(number, _)| number.is_multiple_of(every)).count(),
            ViewSource::Video(path) => video::promised_frames(path).unwrap_or(0).div_ceil(every),
        }
    }

    /// Hands all pictures whose number is a multiple of `every` to `work`, up to `at_once` of them at a time, in order.
    pub fn for_chunks<E: From<ViewsError>>(
        &self,
        every: usize,
        at_once: usize,
        mut work: impl FnMut(Vec<(usize, GrayImage)>) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut size = None;
        let mut checked = |path: &Path, number: usize, image: GrayImage| {
            let (width, height) = image.dimensions();
            let before = *size.get_or_insert([width, height]);
            let fits = before == [width, height];
            if fits { Ok((number, image)) } else { Err(ViewsError::Size { path: path.into(), number, width, height, before }) }
        };
        match &self.source {
            ViewSource::Pictures(files) => {
                let chosen: Vec<_> = files.iter().filter(|(number, _)| number.is_multiple_of(every)).collect();
                for part in chosen.chunks(at_once) {
                    let read = |(number, path): &&(usize, PathBuf)| checked(path, *number, read_grey(path).map_err(ViewsError::from)?);
                    work(part.iter().map(read).collect::<Result<_, ViewsError>>()?)?;
                }
            }
            ViewSource::Video(path) => {
                let mut video = Video::open(path).map_err(ViewsError::from)?;
                let mut part = Vec::new();
                for number in 0.. {
                    let Some(image) = video.read_grey().map_err(ViewsError::from)? else { break };
                    if number % every == 0 {
                        part.push(checked(path, number, image)?);
                    }
                    if part.len() == at_once {
                        work(std::mem::take(&mut part))?;
                    }
                }
                work(part)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder_of(names: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for name in names {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            GrayImage::new(16, 12).save(path).unwrap();
        }
        folder
    }

    #[test]
    fn globs_match_names() {
        for (pattern, name, fits) in [
            ("left*.png", "left07.png", true),
            ("left*.png", "right07.png", false),
            ("*_a?.jpg", "x_a3.jpg", true),
            ("a*b*c", "a1b2c3", false),
            ("*", "", true),
        ] {
            assert_eq!(matches(pattern.as_bytes(), name.as_bytes()), fits, "{pattern} {name}");
        }
    }

    #[test]
    fn cameras_are_named_by_where_their_paths_differ() {
        let folder = folder_of(&["cam_a/calib/1.png", "cam_b/calib/01.png", "left_001.png", "left_003.png", "right_003.png"]);
        let at = |name: &str| folder.path().join(name);
        let names = |paths: &[PathBuf]| open(paths).map(|all| all.into_iter().map(|c| c.name).collect::<Vec<_>>());
        assert_eq!(names(&[at("cam_a/calib"), at("cam_b/calib")]).unwrap(), ["cam_a", "cam_b"]);
        let globs = [at("left_*.png"), at("right_*.png")];
        assert_eq!(names(&globs).unwrap(), ["left", "right"]);
        let ViewSource::Pictures(left) = &open(&globs).unwrap()[0].source else { panic!("pictures") };
        assert_eq!(left.iter().map(|(n, _)| *n).collect::<Vec<_>>(), [1, 3]);
        assert!(matches!(names(&[at("cam_a"), at("cam_a")]), Err(ViewsError::Twice { .. })));
        assert!(matches!(names(&[at("left_001.png")]), Err(ViewsError::SinglePicture { .. })));
        assert!(matches!(names(&[at("nothing")]), Err(ViewsError::NoFootage { .. })));
        assert!(matches!(names(&[at("up*.png")]), Err(ViewsError::Session(SessionError::Empty { .. }))));
    }

    #[test]
    fn pictures_come_in_chunks_of_one_size() {
        let folder = folder_of(&["c/0.png", "c/1.png", "c/2.png", "c/4.png", "c/6.png"]);
        let camera = &open(&[folder.path().join("c")]).unwrap()[0];
        let mut chunks = Vec::new();
        let gather = |part: Vec<(usize, GrayImage)>| {
            chunks.push(part.iter().map(|(n, _)| *n).collect::<Vec<_>>());
            Ok::<(), ViewsError>(())
        };
        camera.for_chunks(2, 3, gather).unwrap();
        assert_eq!(chunks, [vec![0, 2, 4], vec![6]]);
        assert_eq!((camera.count(2), camera.count(1)), (4, 5));
        GrayImage::new(12, 16).save(folder.path().join("c/4.png")).unwrap();
        let error = camera.for_chunks(1, 8, |_| Ok::<(), ViewsError>(())).unwrap_err().to_string();
        assert!(error.contains("frame 4 is 12x16 px, the frames before are 16x12"), "{error}");
    }
}
