//! Every reader of files from outside, by name: what the fuzz targets run, and the test of what they found.

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use muybridge::io;
use zip::{CompressionMethod, ZipWriter, write::FileOptions};

/// What a reader made of a file: nothing, or its sentence.
pub type Read = Result<(), String>;

/// A reader and the name of the file that it is given.
pub struct Target {
    pub name: &'static str,
    pub file: &'static str,
    pub read: fn(&Path) -> Read,
}

pub const TARGETS: [Target; 12] = [
    Target { name: "calib_toml", file: "Calib.toml", read: |path| told(io::calib_toml::read_rig(path)) },
    Target { name: "rig_files", file: "rig.yml", read: |path| told(io::read_rig_files(&[path.into()], &sized())) },
    Target { name: "bvh", file: "a.bvh", read: bvh },
    Target { name: "asf_amc", file: "a.asf", read: asf_amc },
    Target { name: "c3d", file: "a.c3d", read: |path| told(io::c3d::read(path)) },
    Target { name: "trc", file: "a.trc", read: |path| told(io::trc::read(path)) },
    Target { name: "mot", file: "a.mot", read: |path| told(io::mot::read(path)) },
    Target { name: "ply", file: "a.ply", read: |path| told(io::ply::read_ply(path)) },
    Target { name: "pfm", file: "a.pfm", read: |path| told(io::pfm::read_pfm(path)) },
    Target { name: "model_npz", file: "a.npz", read: |path| told(io::model_npz::read_model(packed(path))) },
    Target { name: "space_npz", file: "a.npz", read: |path| told(io::space_npz::read_space(packed(path))) },
    Target { name: "glb", file: "a.glb", read: |path| told(io::glb::read(path)) },
];

/// A folder of this process, in memory where the system has one there.
pub fn place() -> PathBuf {
    let memory = Path::new("/dev/shm");
    let place = if memory.is_dir() { memory.to_path_buf() } else { std::env::temp_dir() };
    place.join(format!("muybridge-fuzz-{}", std::process::id()))
}

/// Reads the bytes as that target does.
pub fn read(name: &str, bytes: &[u8]) -> Read {
    let target = TARGETS.iter().find(|t| t.name == name).expect("a target of this name");
    let path = place().join(target.file);
    std::fs::create_dir_all(place()).and_then(|()| std::fs::write(&path, bytes)).expect("room for the file");
    (target.read)(&path)
}

fn told<T, E: ToString>(read: Result<T, E>) -> Read {
    read.map(drop).map_err(|error| error.to_string())
}

/// Sizes are asked for where a rig file does not say them.
fn sized() -> io::RigReading {
    io::RigReading { size_px: Some([640, 480]), ..io::RigReading::default() }
}

/// As a person's motion and as a creature's.
fn bvh(path: &Path) -> Read {
    let creature = told(io::creature_bvh::read(path));
    told(io::read_clip(path)).and(creature)
}

/// One text with a skeleton and, behind the first line of equals signs, its motion.
fn asf_amc(path: &Path) -> Read {
    let both = std::fs::read(path).map_err(|error| error.to_string())?;
    let cut = both.windows(5).position(|w| w == b"\n===\n").unwrap_or(both.len());
    let motion = path.with_extension("amc");
    let written = std::fs::write(path, &both[..cut]).and_then(|()| std::fs::write(&motion, both.get(cut + 5..).unwrap_or_default()));
    written.map_err(|error| error.to_string())?;
    told(io::read_clip(&motion))
}

/// Checksums keep changed bytes of an archive away from its arrays. So what does not begin as an archive is packed into one: the
/// arrays' files, each behind a line `===NAME`.
fn packed(path: &Path) -> &Path {
    let bytes = std::fs::read(path).expect("the file");
    if !bytes.starts_with(b"PK") {
        std::fs::write(path, pack(&bytes).expect("an archive in memory")).expect("room for the file");
    }
    path
}

fn pack(bytes: &[u8]) -> zip::result::ZipResult<Vec<u8>> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let mark = b"\n===";
    let marks: Vec<usize> = bytes.windows(mark.len()).enumerate().filter(|(_, w)| w == mark).map(|(i, _)| i).collect();
    for (i, from) in marks.iter().enumerate() {
        let part = &bytes[from + mark.len()..marks.get(i + 1).copied().unwrap_or(bytes.len())];
        let line = part.iter().position(|b| *b == b'\n').unwrap_or(part.len());
        let options = FileOptions::default().compression_method(CompressionMethod::Stored);
        archive.start_file(format!("{}.npy", String::from_utf8_lossy(&part[..line])), options)?;
        archive.write_all(part.get(line + 1..).unwrap_or_default())?;
    }
    Ok(archive.finish()?.into_inner())
}
