//! Session folders: `Calib.toml`, one folder of pictures or one video per camera, empty-stage pictures.
//!
//! Pictures are numbered by the last digits in their names. A number that is missing in every camera is a dropped frame,
//! during which time goes on; one that only some cameras miss is an error, as are truncated files and videos that end
//! early. Symbolic links are followed.

use super::calib_toml::{self, CalibError};
use super::images::{self, ImageError};
use super::session_config;
use super::video::{self, Video, VideoError, VideoFacts};
use crate::footage::{self, FrameSet};
use crate::math::order::quantile;
use crate::rig::{Camera, Rig};
use image::GrayImage;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Frame rate of pictures without any word about it, 1/s.
const DEFAULT_FPS: f64 = 30.0;
/// Frames whose median is the empty stage where there is no picture of it.
const STAGE_FRAMES: usize = 25;
/// Headers of whole videos promise up to this many frames more than they hold.
const HEADER_EXCESS_FRAMES: usize = 2;
/// Time stamps may differ by this share of a frame; a dropped frame is a whole one.
const LARGEST_JITTER: f64 = 0.5;

/// What can be wrong with a session; every message names the folder, file, camera or frame.
#[derive(Debug, thiserror::Error)]
pub enum SessionError {
    #[error("{}: is not a folder; give the session folder that holds Calib.toml", folder.display())]
    NoFolder { folder: PathBuf },
    #[error("{}: cannot be read: {error}", path.display())]
    Read { path: PathBuf, error: std::io::Error },
    #[error(transparent)]
    Calib(#[from] CalibError),
    #[error(transparent)]
    Image(#[from] ImageError),
    #[error(transparent)]
    Video(#[from] VideoError),
    #[error("{}: no folder {camera} and no video {camera}.mp4; put the pictures of {camera} there, or remove [{camera}] from Calib.toml", folder.display())]
    MissingCamera { folder: PathBuf, camera: String },
    #[error("{}: is footage of a camera that Calib.toml does not know; add its table [{camera}] there, or move it away", path.display())]
    UnknownCamera { path: PathBuf, camera: String },
    #[error("{}: both {first} and {second} hold {camera}; keep one of them", folder.display())]
    TwoSources { folder: PathBuf, camera: String, first: String, second: String },
    #[error("{}: some cameras are folders and some are videos; bring all into one form", folder.display())]
    MixedSources { folder: PathBuf },
    #[error("{}: holds no frame; put PNG or JPEG pictures (or a whole video) there", path.display())]
    Empty { path: PathBuf },
    #[error("{}: has no frame number in its name; name pictures like 000017.png", path.display())]
    NoNumber { path: PathBuf },
    #[error("{} and {}: are both frame {number}; the last number in the name must be the frame's", first.display(), second.display())]
    SameNumber { number: usize, first: PathBuf, second: PathBuf },
    #[error("{}: frame {number} is missing in {camera} but not in {other}; add it, or remove it from every camera", folder.display())]
    MissingFrame { folder: PathBuf, camera: String, number: usize, other: String },
    #[error("{}: the cameras have different numbers of frames ({counts}), first difference: {camera} has no frame {number}; all must have the same", folder.display())]
    UnequalCounts { folder: PathBuf, counts: String, camera: String, number: usize },
    #[error("{}: ends early, after {decoded} of {promised} frames; copy it again, or cut all cameras to the same length", path.display())]
    EndsEarly { path: PathBuf, decoded: usize, promised: usize },
    #[error("{}: is {found} px, Calib.toml says {expected} for {camera}; use pictures of the calibrated size", path.display())]
    Size { path: PathBuf, camera: String, found: String, expected: String },
    #[error("{}: only {present} have an empty-stage picture, {absent} has none; give every camera one (NAME_background.png) or none", folder.display())]
    SomeBackgrounds { folder: PathBuf, present: String, absent: String },
    #[error("{}: {message}", path.display())]
    Config { path: PathBuf, message: String },
    #[error("a frame rate of {fps} 1/s is impossible; give a number above 0, such as 30")]
    Fps { fps: f64 },
    #[error("{}: runs at {fps} frames/s, {} at {other_fps}; synchronized cameras have one rate", path.display(), other.display())]
    UnequalFps { path: PathBuf, fps: f64, other: PathBuf, other_fps: f64 },
    #[error(
        "{}: frame {frame} comes {apart_ms:.0} ms {side} after the first one than in {}; a camera dropped frames or runs at another rate, film again with one trigger for all",
        path.display(),
        other.display()
    )]
    UnequalTimes { path: PathBuf, other: PathBuf, frame: usize, apart_ms: f64, side: &'static str },
    #[error("frame {index} of a video cannot be read alone; read videos from the first frame on")]
    VideoAccess { index: usize },
    #[error("there is no frame {index}, the session has {count}")]
    NoFrame { index: usize, count: usize },
}

/// Where the frames of one camera are.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// One file per frame, in the order of `Session::frame_numbers`.
    Images(Vec<PathBuf>),
    Video(PathBuf),
}

/// Synchronized footage of a calibrated rig.
#[derive(Clone, Debug)]
pub struct Session {
    pub folder: PathBuf,
    pub rig: Rig,
    /// One per camera of the rig.
    pub cameras: Vec<Source>,
    /// Pictures of the empty stage, one per camera.
    pub backgrounds: Option<Vec<GrayImage>>,
    /// Frames per second.
    pub fps: f64,
    /// Ascending; a gap is a dropped frame.
    pub frame_numbers: Vec<usize>,
    /// The length of `frame_numbers`.
    pub frame_count: usize,
}

impl Session {
    /// Opens a session folder and looks through it: counts, numbers, first sizes, ends of files. Videos are decoded once
    /// to count their frames. `fps_override` goes before every other frame rate. Also returns notices for the user.
    pub fn open(folder: &Path, fps_override: Option<f64>) -> Result<(Session, Vec<String>), SessionError> {
        if !folder.is_dir() {
            return Err(SessionError::NoFolder { folder: folder.into() });
        }
        let rig = calib_toml::read_rig(&folder.join("Calib.toml"))?;
        let entries = list(folder)?;
        refuse_unknown_cameras(&entries, &rig)?;
        let sources = rig.cameras.iter().map(|c| find_source(folder, &entries, &c.name)).collect::<Result<Vec<_>, _>>()?;
        let mut notices = Vec::new();
        let (cameras, frame_numbers, video_fps) = if sources.iter().all(|s| s.is_dir()) {
            let (cameras, numbers) = open_images(folder, &rig, &sources, &mut notices)?;
            (cameras, numbers, None)
        } else if sources.iter().any(|s| s.is_dir()) {
            return Err(SessionError::MixedSources { folder: folder.into() });
        } else {
            let (count, fps) = open_videos(folder, &rig, &sources, &mut notices)?;
            (sources.into_iter().map(Source::Video).collect(), (0..count).collect(), fps)
        };
        let fps = choose_fps(fps_override, video_fps, session_config::read(folder)?.fps, &mut notices)?;
        let backgrounds = read_backgrounds(folder, &entries, &rig)?;
        let frame_count = frame_numbers.len();
        Ok((Session { folder: folder.into(), rig, cameras, backgrounds, fps, frame_numbers, frame_count }, notices))
    }

    /// All frames in order, read one after the other; ends after the first error.
    pub fn frames(&self) -> Frames<'_> {
        Frames { session: self, next: 0, videos: Vec::new() }
    }

    /// The empty stage of every camera: its picture, else the median over frames spread over the session.
    pub fn stages(&self) -> Result<Vec<GrayImage>, SessionError> {
        if let Some(backgrounds) = &self.backgrounds {
            return Ok(backgrounds.clone());
        }
        let chosen = footage::spread(self.frame_count, STAGE_FRAMES);
        let frames: Vec<FrameSet> = if self.has_random_access() {
            chosen.par_iter().map(|&index| self.frame(index)).collect::<Result<_, _>>()?
        } else {
            let wanted = self.frames().enumerate().filter(|(index, frame)| frame.is_err() || chosen.contains(index));
            wanted.map(|(_, frame)| frame).collect::<Result<_, _>>()?
        };
        let of_camera = |k: usize| frames.iter().map(|frame| frame.images[k].clone()).collect::<Vec<_>>();
        // There is at least one frame, and all are of the camera's size.
        Ok((0..self.cameras.len()).filter_map(|k| footage::stage_from_frames(&of_camera(k))).collect())
    }

    /// Whether [`frame`](Self::frame) works: pictures can be read in any order and from several threads, videos cannot.
    pub fn has_random_access(&self) -> bool {
        self.cameras.iter().all(|source| matches!(source, Source::Images(_)))
    }

    /// The frame at a position from 0 (not its number); for folders of pictures only.
    pub fn frame(&self, index: usize) -> Result<FrameSet, SessionError> {
        let read = |(camera, source): (&Camera, &Source)| match source {
            Source::Video(_) => Err(SessionError::VideoAccess { index }),
            Source::Images(files) => {
                let path = files.get(index).ok_or(SessionError::NoFrame { index, count: self.frame_count })?;
                read_sized(path, camera)
            }
        };
        let images: Vec<Result<_, _>> = self.rig.cameras.par_iter().zip(&self.cameras).map(read).collect();
        let images = images.into_iter().collect::<Result<_, _>>()?;
        Ok(self.frame_set(index, images))
    }

    fn frame_set(&self, index: usize, images: Vec<GrayImage>) -> FrameSet {
        let number = self.frame_numbers[index];
        FrameSet { number, time_s: (number - self.frame_numbers[0]) as f64 / self.fps, images }
    }
}

/// The frames of a session in order.
pub struct Frames<'a> {
    session: &'a Session,
    next: usize,
    /// Open from the first frame on.
    videos: Vec<Video>,
}

impl Iterator for Frames<'_> {
    type Item = Result<FrameSet, SessionError>;

    fn next(&mut self) -> Option<Self::Item> {
        let index = self.next;
        if index >= self.session.frame_count {
            return None;
        }
        let frame = if self.session.has_random_access() { self.session.frame(index) } else { self.decode(index) };
        self.next = if frame.is_ok() { index + 1 } else { self.session.frame_count };
        Some(frame)
    }
}

impl Frames<'_> {
    fn decode(&mut self, index: usize) -> Result<FrameSet, SessionError> {
        let session = self.session;
        let paths: Vec<&Path> =
            session.cameras.iter().filter_map(|s| if let Source::Video(path) = s { Some(path.as_path()) } else { None }).collect();
        if self.videos.is_empty() {
            self.videos = paths.iter().map(|path| Video::open(path)).collect::<Result<_, _>>()?;
        }
        let mut images = Vec::with_capacity(paths.len());
        for ((video, path), camera) in self.videos.iter_mut().zip(paths).zip(&session.rig.cameras) {
            let image = video.read_grey()?.ok_or_else(|| SessionError::EndsEarly {
                path: path.into(),
                decoded: index,
                promised: session.frame_count,
            })?;
            images.push(sized(image, path, camera)?);
        }
        Ok(session.frame_set(index, images))
    }
}

/// Visible names in a folder, naturally sorted.
pub(super) fn list(folder: &Path) -> Result<Vec<PathBuf>, SessionError> {
    let failed = |error| SessionError::Read { path: folder.into(), error };
    let paths =
        std::fs::read_dir(folder).map_err(failed)?.map(|entry| entry.map(|e| e.path())).collect::<Result<Vec<_>, _>>().map_err(failed)?;
    let mut named: Vec<_> = paths.into_iter().map(|path| (file_name(&path), path)).filter(|(name, _)| !name.starts_with('.')).collect();
    named.sort_by(|a, b| natord::compare(&a.0, &b.0).then_with(|| a.0.cmp(&b.0)));
    Ok(named.into_iter().map(|(_, path)| path).collect())
}

pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

pub(super) fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Footage that looks like a camera's (`cam` and digits) must be in the rig.
fn refuse_unknown_cameras(entries: &[PathBuf], rig: &Rig) -> Result<(), SessionError> {
    for path in entries.iter().filter(|p| p.is_dir() || video::is_video_name(p)) {
        let camera = if path.is_dir() { file_name(path) } else { stem(path) };
        let digits = camera.strip_prefix("cam").map(|rest| rest.trim_start_matches(['_', '-']));
        let is_camera = digits.is_some_and(|d| !d.is_empty() && d.chars().all(|c| c.is_ascii_digit()));
        if is_camera && rig.cameras.iter().all(|c| c.name != camera) {
            return Err(SessionError::UnknownCamera { path: path.clone(), camera });
        }
    }
    Ok(())
}

/// The folder or video of a camera.
fn find_source(folder: &Path, entries: &[PathBuf], camera: &str) -> Result<PathBuf, SessionError> {
    let belongs = |p: &&PathBuf| if p.is_dir() { file_name(p) == camera } else { video::is_video_name(p) && stem(p) == camera };
    let mut found = entries.iter().filter(belongs);
    match (found.next(), found.next()) {
        (None, _) => Err(SessionError::MissingCamera { folder: folder.into(), camera: camera.into() }),
        (Some(source), None) => Ok(source.clone()),
        (Some(first), Some(second)) => Err(SessionError::TwoSources {
            folder: folder.into(),
            camera: camera.into(),
            first: file_name(first),
            second: file_name(second),
        }),
    }
}

fn open_images(
    folder: &Path,
    rig: &Rig,
    sources: &[PathBuf],
    notices: &mut Vec<String>,
) -> Result<(Vec<Source>, Vec<usize>), SessionError> {
    let listed = sources.iter().map(|source| numbered_images(source)).collect::<Result<Vec<_>, _>>()?;
    let numbers = common_numbers(folder, rig, &listed)?;
    notices.extend(dropped_notice(&numbers));
    for (files, camera) in listed.iter().zip(&rig.cameras) {
        // The first failure by order, whichever thread meets it.
        if let Some(Err(error)) = files.par_iter().map(|(_, path)| images::check_ends(path)).find_first(Result::is_err) {
            return Err(error.into());
        }
        read_sized(&files[0].1, camera)?;
    }
    let cameras = listed.into_iter().map(|files| Source::Images(files.into_iter().map(|(_, path)| path).collect())).collect();
    Ok((cameras, numbers))
}

/// The pictures of a folder by ascending frame number, at least one.
pub(super) fn numbered_images(folder: &Path) -> Result<Vec<(usize, PathBuf)>, SessionError> {
    numbered(folder, list(folder)?)
}

/// The pictures among `files`, of which `place` holds or names all.
pub(super) fn numbered(place: &Path, files: Vec<PathBuf>) -> Result<Vec<(usize, PathBuf)>, SessionError> {
    let is_picture = |path: &PathBuf| images::is_image_name(path) && !path.is_dir();
    let number = |path: PathBuf| Ok((frame_number(&path).ok_or_else(|| SessionError::NoNumber { path: path.clone() })?, path));
    let mut files = files.into_iter().filter(is_picture).map(number).collect::<Result<Vec<_>, SessionError>>()?;
    files.sort_by_key(|(number, _)| *number);
    if let Some(pair) = files.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        return Err(SessionError::SameNumber { number: pair[0].0, first: pair[0].1.clone(), second: pair[1].1.clone() });
    }
    if files.is_empty() { Err(SessionError::Empty { path: place.into() }) } else { Ok(files) }
}

/// The last run of digits in the name, without the extension.
fn frame_number(path: &Path) -> Option<usize> {
    let stem = stem(path);
    stem.split(|c: char| !c.is_ascii_digit()).rfind(|digits| !digits.is_empty())?.parse().ok()
}

/// The frame numbers, which must be the same in every camera.
fn common_numbers(folder: &Path, rig: &Rig, listed: &[Vec<(usize, PathBuf)>]) -> Result<Vec<usize>, SessionError> {
    let sets: Vec<BTreeSet<usize>> = listed.iter().map(|files| files.iter().map(|f| f.0).collect()).collect();
    let all: BTreeSet<usize> = sets.iter().flatten().copied().collect();
    let name = |k: usize| rig.cameras[k].name.clone();
    for &number in &all {
        let (Some(without), Some(with)) = (sets.iter().position(|s| !s.contains(&number)), sets.iter().position(|s| s.contains(&number)))
        else {
            continue;
        };
        let (folder, camera) = (folder.to_path_buf(), name(without));
        if sets.iter().all(|s| s.len() == sets[0].len()) {
            return Err(SessionError::MissingFrame { folder, camera, number, other: name(with) });
        }
        let counts = counts_text(rig, sets.iter().map(BTreeSet::len));
        return Err(SessionError::UnequalCounts { folder, counts, camera, number });
    }
    Ok(all.into_iter().collect())
}

fn counts_text(rig: &Rig, counts: impl Iterator<Item = usize>) -> String {
    rig.cameras.iter().zip(counts).map(|(camera, count)| format!("{} {count}", camera.name)).collect::<Vec<_>>().join(", ")
}

fn dropped_notice(numbers: &[usize]) -> Option<String> {
    let gaps: Vec<_> = numbers.windows(2).filter(|pair| pair[1] - pair[0] > 1).collect();
    let first = gaps.first()?[0] + 1;
    let dropped: usize = gaps.iter().map(|pair| pair[1] - pair[0] - 1).sum();
    Some(format!("{dropped} frame numbers are missing in every camera, the first is {first}; they count as dropped frames"))
}

fn open_videos(folder: &Path, rig: &Rig, sources: &[PathBuf], notices: &mut Vec<String>) -> Result<(usize, Option<f64>), SessionError> {
    let facts = sources.par_iter().map(|path| video::count_frames(path)).collect::<Result<Vec<VideoFacts>, _>>()?;
    let most = facts.iter().map(|f| f.decoded).max().unwrap_or(0);
    for ((fact, path), camera) in facts.iter().zip(sources).zip(&rig.cameras) {
        let (decoded, promised, path) = (fact.decoded, fact.promised, path.to_path_buf());
        if fact.size_px != camera.size_px {
            return Err(size_error(&path, camera, fact.size_px));
        }
        if decoded < promised && (decoded < most || promised - decoded > HEADER_EXCESS_FRAMES) {
            return Err(SessionError::EndsEarly { path, decoded, promised });
        }
        if decoded == 0 {
            return Err(SessionError::Empty { path });
        }
    }
    if let Some(shortest) = facts.iter().position(|f| f.decoded < most) {
        let counts = counts_text(rig, facts.iter().map(|f| f.decoded));
        let (folder, camera, number) = (folder.to_path_buf(), rig.cameras[shortest].name.clone(), facts[shortest].decoded);
        return Err(SessionError::UnequalCounts { folder, counts, camera, number });
    }
    let short = facts.iter().zip(sources).filter(|(f, _)| f.decoded < f.promised);
    notices.extend(short.map(|(f, path)| format!("{}: its header promises {} frames, it holds {}", path.display(), f.promised, f.decoded)));
    let fps = common_fps(&facts, sources)?;
    notices.extend(common_times(&facts, sources)?);
    Ok((most, fps))
}

/// Frames of the same number must come at the same time after the first; a notice where that time is not uniform.
fn common_times(facts: &[VideoFacts], sources: &[PathBuf]) -> Result<Option<String>, SessionError> {
    let mut stamped = facts.iter().zip(sources).filter(|(f, _)| f.times_s.len() > 1).map(|(f, path)| (&f.times_s, path));
    let Some((times, other)) = stamped.next() else { return Ok(None) };
    let Some(usual) = quantile(times.windows(2).map(|pair| pair[1] - pair[0]).collect(), 0.5) else { return Ok(None) };
    for (own, path) in stamped {
        let apart = own.iter().zip(times).map(|(a, b)| (a - own[0]) - (b - times[0])).enumerate();
        if let Some((frame, apart_s)) = apart.into_iter().find(|(_, apart)| apart.abs() > LARGEST_JITTER * usual) {
            let side = if apart_s > 0.0 { "later" } else { "earlier" };
            let (path, other, apart_ms) = (path.clone(), other.clone(), 1e3 * apart_s.abs());
            return Err(SessionError::UnequalTimes { path, other, frame, apart_ms, side });
        }
    }
    let uneven = |pair: &[f64]| ((pair[1] - pair[0]) / usual - 1.0).abs() > LARGEST_JITTER;
    let count = times.windows(2).filter(|pair| uneven(pair)).count();
    let first = times.windows(2).position(uneven);
    Ok(first.map(|first| {
        format!(
            "the frame rate varies: {count} frames, the first is {}, come not {:.1} ms after the one before; frames are taken as evenly spaced, so speeds will be wrong there",
            first + 1,
            1e3 * usual
        )
    }))
}

/// The videos' frame rate; `None` where no file says it.
fn common_fps(facts: &[VideoFacts], sources: &[PathBuf]) -> Result<Option<f64>, SessionError> {
    let mut said = facts.iter().zip(sources).filter_map(|(f, path)| Some((f.fps?, path)));
    let Some((other_fps, other)) = said.next() else { return Ok(None) };
    match said.find(|(fps, _)| (fps - other_fps).abs() > 0.01 * other_fps) {
        Some((fps, path)) => Err(SessionError::UnequalFps { path: path.clone(), fps, other: other.clone(), other_fps }),
        None => Ok(Some(other_fps)),
    }
}

fn choose_fps(given: Option<f64>, video: Option<f64>, config: Option<f64>, notices: &mut Vec<String>) -> Result<f64, SessionError> {
    let fps = given.or(video).or(config).unwrap_or_else(|| {
        notices.push(format!("nothing says the frame rate; taking {DEFAULT_FPS} frames/s (give --fps, or fps in muybridge.toml)"));
        DEFAULT_FPS
    });
    if !fps.is_finite() || fps <= 0.0 {
        return Err(SessionError::Fps { fps });
    }
    let overruled = if given.is_some() { video } else { video.and(config) };
    notices.extend(overruled.filter(|o| (o - fps).abs() > 0.01 * fps).map(|o| format!("taking {fps} frames/s, not {o}")));
    Ok(fps)
}

fn read_backgrounds(folder: &Path, entries: &[PathBuf], rig: &Rig) -> Result<Option<Vec<GrayImage>>, SessionError> {
    let find = |camera: &Camera| {
        let name = format!("{}_background", camera.name);
        entries.iter().find(|path| images::is_image_name(path) && stem(path) == name)
    };
    let found: Vec<_> = rig.cameras.iter().map(|camera| (camera, find(camera))).collect();
    let present: Vec<_> = found.iter().filter(|(_, path)| path.is_some()).map(|(camera, _)| camera.name.as_str()).collect();
    if present.is_empty() {
        return Ok(None);
    }
    let read = |(camera, path): &(&Camera, Option<&PathBuf>)| match path {
        Some(path) => read_sized(path, camera),
        None => Err(SessionError::SomeBackgrounds { folder: folder.into(), present: present.join(", "), absent: camera.name.clone() }),
    };
    let images: Vec<Result<_, _>> = found.par_iter().map(read).collect();
    images.into_iter().collect::<Result<_, _>>().map(Some)
}

fn read_sized(path: &Path, camera: &Camera) -> Result<GrayImage, SessionError> {
    sized(images::read_grey(path)?, path, camera)
}

fn sized(image: GrayImage, path: &Path, camera: &Camera) -> Result<GrayImage, SessionError> {
    let found = [image.width(), image.height()];
    if found == camera.size_px { Ok(image) } else { Err(size_error(path, camera, found)) }
}

fn size_error(path: &Path, camera: &Camera, found: [u32; 2]) -> SessionError {
    let text = |[width, height]: [u32; 2]| format!("{width}x{height}");
    SessionError::Size { path: path.into(), camera: camera.name.clone(), found: text(found), expected: text(camera.size_px) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Rotation3, Vector3};
    use opencv::core::{Mat, Size};
    use opencv::prelude::*;
    use opencv::videoio::VideoWriter;
    use std::fs;

    const SIZE: [u32; 2] = [48, 32];

    fn rig(cameras: usize) -> Rig {
        let camera = |k: usize| Camera {
            name: format!("cam_{k:02}"),
            size_px: SIZE,
            matrix: Matrix3::new(50.0, 0.0, 24.0, 0.0, 50.0, 16.0, 0.0, 0.0, 1.0),
            lens: crate::rig::Lens::IDEAL,
            camera_from_world: Rotation3::identity(),
            translation: Vector3::new(-0.3 * k as f64, 0.0, 0.0),
        };
        Rig { cameras: (0..cameras).map(camera).collect(), up: Default::default() }
    }

    /// A picture whose grey tells camera and frame.
    fn picture(camera: usize, frame: usize) -> GrayImage {
        GrayImage::from_pixel(SIZE[0], SIZE[1], image::Luma([(100 * camera + 5 * frame) as u8]))
    }

    /// A study folder with a session `walk` of two cameras with the given picture names.
    fn study(names: [&[&str]; 2]) -> tempfile::TempDir {
        let study = tempfile::tempdir().unwrap();
        let session = study.path().join("walk");
        for (k, names) in names.iter().enumerate() {
            let folder = session.join(format!("cam_{k:02}"));
            fs::create_dir_all(&folder).unwrap();
            for (frame, name) in names.iter().enumerate() {
                picture(k, frame).save(folder.join(name)).unwrap();
            }
        }
        calib_toml::write_rig(&session.join("Calib.toml"), &rig(2)).unwrap();
        study
    }

    fn open(study: &tempfile::TempDir) -> Result<(Session, Vec<String>), SessionError> {
        Session::open(&study.path().join("walk"), None)
    }

    fn refusal(study: &tempfile::TempDir) -> String {
        open(study).map(|(session, _)| session.frames().find_map(Result::err).unwrap()).unwrap_or_else(|e| e).to_string()
    }

    #[test]
    fn frames_come_in_order_of_their_numbers_and_dropped_ones_cost_time() {
        let names = ["f_1.png", "f_2.png", "f_10.png"];
        let study = study([&names, &names]);
        let (session, notices) = open(&study).unwrap();
        assert_eq!((session.frame_numbers.as_slice(), session.frame_count, session.fps), (&[1, 2, 10][..], 3, 30.0));
        assert!(notices[0].contains("7 frame numbers are missing in every camera, the first is 3"), "{notices:?}");
        assert!(notices[1].contains("30 frames/s"), "{notices:?}");
        let frames: Vec<_> = session.frames().collect::<Result<_, _>>().unwrap();
        for (i, frame) in frames.iter().enumerate() {
            assert_eq!(frame.images, [picture(0, i), picture(1, i)]);
            assert_eq!(frame.number, [1, 2, 10][i]);
            assert!((frame.time_s - [0.0, 1.0, 9.0][i] / 30.0).abs() < 1e-12);
            assert_eq!(&session.frame(i).unwrap(), frame);
        }
        assert!(matches!(session.frame(3), Err(SessionError::NoFrame { .. })));
    }

    #[test]
    fn the_frame_rate_comes_from_the_nearer_file_and_the_option_wins() {
        let study = study([&["0.png"], &["0.png"]]);
        let walk = study.path().join("walk");
        let fps = |given| Session::open(&walk, given).unwrap().0.fps;
        fs::write(study.path().join("muybridge.toml"), "fps = 25\n").unwrap();
        assert_eq!(fps(None), 25.0);
        fs::write(walk.join("muybridge.toml"), "fps = 50.0\n").unwrap();
        assert_eq!(fps(None), 50.0);
        assert_eq!(fps(Some(120.0)), 120.0);
        assert!(matches!(Session::open(&walk, Some(0.0)), Err(SessionError::Fps { .. })));
        fs::write(walk.join("muybridge.toml"), "\nfbs = 50.0\n").unwrap();
        let message = refusal(&study);
        assert!(message.contains("muybridge.toml: line 2: unknown field `fbs`") && !message.contains('\n'), "{message}");
    }

    #[test]
    fn numbers_and_counts_must_agree() {
        let cases: [([&[&str]; 2], &str); 6] = [
            ([&["0.png", "1.png"], &["0.png", "2.png"]], "frame 1 is missing in cam_01 but not in cam_00"),
            ([&["0.png", "1.png"], &["0.png"]], "(cam_00 2, cam_01 1), first difference: cam_01 has no frame 1"),
            ([&["0.png"], &[]], "cam_01: holds no frame"),
            ([&["0.png", "a.png"], &["0.png", "1.png"]], "a.png: has no frame number"),
            ([&["1.png", "01.png"], &["0.png", "1.png"]], "are both frame 1"),
            ([&["0.png"], &["0.tif"]], "cam_01: holds no frame"),
        ];
        for (names, expected) in cases {
            let names = names.map(|n| n.iter().map(|x| x.replace(".tif", ".png")).collect::<Vec<_>>());
            let borrowed: Vec<Vec<&str>> = names.iter().map(|n| n.iter().map(String::as_str).collect()).collect();
            let study = study([&borrowed[0], &borrowed[1]]);
            if expected.contains("cam_01: holds") && !borrowed[1].is_empty() {
                let file = study.path().join("walk/cam_01/0.png");
                fs::rename(&file, file.with_extension("tif")).unwrap();
            }
            let message = refusal(&study);
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn cameras_and_tables_must_agree() {
        let names: [&[&str]; 2] = [&["0.png"], &["0.png"]];
        let session = |change: &dyn Fn(&Path)| {
            let study = study(names);
            change(&study.path().join("walk"));
            refusal(&study)
        };
        let missing = session(&|walk| fs::remove_dir_all(walk.join("cam_01")).unwrap());
        assert!(missing.contains("no folder cam_01 and no video"), "{missing}");
        let unknown = session(&|walk| calib_toml::write_rig(&walk.join("Calib.toml"), &rig(1)).unwrap());
        assert!(unknown.contains("cam_01: is footage of a camera that Calib.toml does not know; add its table [cam_01]"), "{unknown}");
        let two = session(&|walk| fs::write(walk.join("cam_01.avi"), "").unwrap());
        assert!(two.contains("both cam_01 and cam_01.avi hold cam_01"), "{two}");
        let background = session(&|walk| picture(0, 0).save(walk.join("cam_00_background.png")).unwrap());
        assert!(background.contains("only cam_00 have an empty-stage picture, cam_01 has none"), "{background}");
        let size = session(&|walk| GrayImage::new(40, 30).save(walk.join("cam_01/0.png")).unwrap());
        assert!(size.contains("0.png: is 40x30 px, Calib.toml says 48x32"), "{size}");
        assert!(matches!(Session::open(Path::new("nowhere"), None), Err(SessionError::NoFolder { .. })));
    }

    #[test]
    fn truncated_pictures_are_found_before_any_frame_is_read() {
        let study = study([&["0.png", "1.png", "2.png"], &["0.jpg", "1.jpg", "2.jpg"]]);
        assert!(open(&study).is_ok());
        for name in ["cam_00/1.png", "cam_01/1.jpg"] {
            let path = study.path().join("walk").join(name);
            let whole = fs::read(&path).unwrap();
            fs::write(&path, &whole[..whole.len() * 2 / 3]).unwrap();
            let message = open(&study).unwrap_err().to_string();
            assert!(message.contains(&format!("{name}: is truncated")), "{message}");
            fs::write(&path, whole).unwrap();
        }
    }

    #[cfg(unix)]
    #[test]
    fn symbolic_links_are_followed() {
        let study = study([&["0.png"], &["0.png"]]);
        let walk = study.path().join("walk");
        fs::rename(walk.join("cam_01"), study.path().join("elsewhere")).unwrap();
        std::os::unix::fs::symlink(study.path().join("elsewhere"), walk.join("cam_01")).unwrap();
        std::os::unix::fs::symlink("0.png", walk.join("cam_00/1.png")).unwrap();
        std::os::unix::fs::symlink("0.png", walk.join("cam_01/1.png")).unwrap();
        let frames: Vec<_> = open(&study).unwrap().0.frames().collect::<Result<_, _>>().unwrap();
        assert_eq!((frames.len(), &frames[0].images), (2, &frames[1].images));
    }

    fn write_video(path: &Path, camera: usize, frames: usize, fps: f64) {
        let [a, b, c, d] = if path.extension().unwrap() == "mp4" { ['m', 'p', '4', 'v'] } else { ['M', 'J', 'P', 'G'] };
        let fourcc = VideoWriter::fourcc(a, b, c, d).unwrap();
        let size = Size::new(SIZE[0] as i32, SIZE[1] as i32);
        let mut writer = VideoWriter::new(path, fourcc, fps, size, false).unwrap();
        assert!(writer.is_opened().unwrap());
        for frame in 0..frames {
            let mut noisy = picture(camera, frame);
            noisy.enumerate_pixels_mut().for_each(|(x, y, p)| p.0[0] += ((7 * x * x + 3 * y * y + x * y) % 5) as u8);
            writer.write(&Mat::new_rows_cols_with_data(SIZE[1] as i32, SIZE[0] as i32, noisy.as_raw()).unwrap()).unwrap();
        }
        writer.release().unwrap();
    }

    /// Makes the frame after `late` in an MP4 of `frames` come one frame later, and the next in time again: the table of
    /// durations (stts) gets three more entries.
    fn delay(path: &Path, frames: u32, late: u32) {
        let mut bytes = fs::read(path).unwrap();
        let find = |bytes: &[u8], name: &[u8]| bytes.windows(4).position(|w| w == name).unwrap();
        let number = |bytes: &[u8], at: usize| u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap());
        for name in [b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"] {
            let at = find(&bytes, name) - 4;
            let longer = number(&bytes, at) + 24;
            bytes[at..at + 4].copy_from_slice(&longer.to_be_bytes());
        }
        let entries = find(&bytes, b"stts") + 8;
        assert_eq!([number(&bytes, entries), number(&bytes, entries + 4)], [1, frames]);
        let step = number(&bytes, entries + 8);
        let table = [4, late, step, 1, 2 * step - 1, 1, 1, frames - late - 2, step];
        bytes.splice(entries..entries + 12, table.iter().flat_map(|n: &u32| n.to_be_bytes()));
        fs::write(path, bytes).unwrap();
    }

    #[test]
    fn time_stamps_tell_dropped_frames() {
        let study = tempfile::tempdir().unwrap();
        let walk = study.path().join("walk");
        fs::create_dir(&walk).unwrap();
        calib_toml::write_rig(&walk.join("Calib.toml"), &rig(2)).unwrap();
        let paths = [walk.join("cam_00.mp4"), walk.join("cam_01.mp4")];
        paths.iter().enumerate().for_each(|(k, path)| write_video(path, k, 20, 25.0));
        let (session, notices) = open(&study).unwrap();
        assert_eq!((session.frame_count, notices), (20, vec![]));
        delay(&paths[1], 20, 7);
        let refused = refusal(&study);
        assert!(refused.contains("cam_01.mp4: frame 8 comes 40 ms later after the first one than in "), "{refused}");
        delay(&paths[0], 20, 7);
        let (_, notices) = open(&study).unwrap();
        assert!(notices[0].contains("2 frames, the first is 8, come not 40.0 ms"), "{notices:?}");
    }

    #[test]
    fn videos_are_read_like_folders_and_their_ends_are_watched() {
        let study = tempfile::tempdir().unwrap();
        let walk = study.path().join("walk");
        fs::create_dir(&walk).unwrap();
        calib_toml::write_rig(&walk.join("Calib.toml"), &rig(2)).unwrap();
        let paths = [walk.join("cam_00.avi"), walk.join("cam_01.avi")];
        paths.iter().enumerate().for_each(|(k, path)| write_video(path, k, 20, 25.0));
        let (session, notices) = open(&study).unwrap();
        assert_eq!((session.fps, session.frame_count, notices.len()), (25.0, 20, 0));
        for (i, frame) in session.frames().enumerate() {
            let frame = frame.unwrap();
            assert_eq!((frame.number, frame.images.len()), (i, 2));
            for (k, image) in frame.images.iter().enumerate() {
                let mean = image.iter().map(|&p| f64::from(p)).sum::<f64>() / 1536.0;
                assert!((mean - 2.0 - (100 * k + 5 * i) as f64).abs() < 1.5, "camera {k}, frame {i}: {mean}");
            }
        }
        assert!(matches!(session.frame(0), Err(SessionError::VideoAccess { .. })));

        let whole = fs::read(&paths[1]).unwrap();
        fs::write(&paths[1], &whole[..whole.len() * 6 / 10]).unwrap();
        let cut = refusal(&study);
        assert!(cut.contains("cam_01.avi: ends early, after ") && cut.contains(" of 20 frames"), "{cut}");
        write_video(&paths[1], 1, 18, 25.0);
        assert!(refusal(&study).contains("(cam_00 20, cam_01 18)"));
        write_video(&paths[1], 1, 20, 30.0);
        assert!(refusal(&study).contains("cam_01.avi: runs at 30 frames/s"));
        fs::write(&paths[1], "no video").unwrap();
        assert!(refusal(&study).contains("cam_01.avi: cannot be opened"));
    }
}
