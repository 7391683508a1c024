//! Files that break parsers: each gives a motion or one sentence, never a panic, and memory stays in proportion to the file.

use std::path::{Path, PathBuf};

use muybridge::io::markers::read;
use muybridge::io::read_clip;
use nalgebra::Vector3;
use rayon::prelude::*;

fn torture() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/mocap/parser-torture");
    if !path.is_dir() {
        println!("skipped: no ../shared/data/mocap/parser-torture");
    }
    path.is_dir().then_some(path)
}

fn files(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap().flatten().map(|e| e.path()) {
        let ending = entry.extension().unwrap_or_default().to_string_lossy().to_lowercase();
        if entry.is_dir() {
            found.extend(files(&entry, endings));
        } else if endings.contains(&ending.as_str()) {
            found.push(entry);
        }
    }
    found.sort();
    found
}

fn one_sentence(error: &str, path: &Path) {
    assert!(!error.contains('\n') && error.len() < 900 && error.contains(&path.display().to_string()), "{error}");
}

#[test]
fn every_file_gives_a_motion_or_one_sentence() {
    let Some(folder) = torture() else { return };
    let all = files(&folder, &["c3d", "trc", "bvh", "amc"]);
    assert_eq!(all.len(), 89);
    let read: Vec<String> = all
        .par_iter()
        .map(|path| match read_clip(path) {
            Ok(read) => {
                assert!(read.clip.poses.iter().all(|p| p.root.iter().all(|v| v.is_finite())), "{}", path.display());
                format!("{} frames, {:?}", read.clip.poses.len(), read.notices)
            }
            Err(error) => {
                one_sentence(&error.to_string(), path);
                error.to_string()
            }
        })
        .collect();
    for (path, what) in all.iter().zip(&read) {
        println!("{}: {what}", path.strip_prefix(&folder).unwrap().display());
    }
}

/// The markers alone, which need no known set: `c3dio` reads 73 of these files.
#[test]
fn points_of_c3d_files_are_those_of_another_reader() {
    let Some(folder) = torture() else { return };
    let all = files(&folder, &["c3d"]);
    let (mut read_by_us, mut compared) = (0, 0);
    for path in &all {
        let ours = read(path).map(|r| r.0);
        if let Err(error) = &ours {
            one_sentence(&error.to_string(), path);
            println!("{error}");
        }
        read_by_us += usize::from(ours.is_ok());
        let Ok(theirs) = c3dio::C3d::load_path(path.clone()) else { continue };
        let Ok(ours) = ours else {
            assert!(theirs.points.cols() == 0 || theirs.points.rows() == 0, "{} is read by c3dio", path.display());
            continue;
        };
        let (rows, cols) = (theirs.points.rows(), theirs.points.cols());
        // A header of no frames, where other parameters count them.
        if rows == 0 {
            continue;
        }
        assert_eq!((ours.frames.len(), ours.frames[0].len()), (rows, cols), "{}", path.display());
        assert!((ours.fps - f64::from(theirs.points.frame_rate)).abs() < 1e-4 * ours.fps, "{}", path.display());
        for (f, frame) in ours.frames.iter().enumerate() {
            for (c, x) in frame.iter().enumerate() {
                let Some(x) = x else { continue };
                let point = theirs.points[f][c].point.map(f64::from);
                assert!((x - Vector3::from(point)).norm() <= 1e-5 * x.norm(), "{} frame {f} point {c}: {x:?} {point:?}", path.display());
            }
        }
        compared += 1;
    }
    println!("{} C3D files, {read_by_us} read, {compared} equal to c3dio's", all.len());
    assert!(read_by_us + 2 >= all.len() && 5 * compared > 3 * all.len(), "{read_by_us} {compared}");
}

#[test]
fn one_trial_in_six_encodings_is_one_recording() {
    let Some(folder) = torture() else { return };
    for sample in ["sample01", "sample02"] {
        let all = files(&folder.join("c3d/btkdata/Input/C3DSamples/c3d.org").join(sample), &["c3d"]);
        assert_eq!(all.len(), 6);
        let read: Vec<_> = all.iter().map(|p| read(p).unwrap().0).collect();
        for other in &read[1..] {
            assert_eq!((&other.names, other.fps, other.frames.len()), (&read[0].names, read[0].fps, read[0].frames.len()));
            for (a, b) in read[0].frames.iter().flatten().zip(other.frames.iter().flatten()) {
                // Integers are steps of the scale, a third of a millimetre at most here.
                let same = match (a, b) {
                    (Some(a), Some(b)) => (a - b).norm() < 0.6,
                    (a, b) => a == b,
                };
                assert!(same, "{sample}: {a:?} {b:?}");
            }
        }
    }
}

/// Cut short, and with bytes of the header and the parameters changed, a file still gives points or a sentence at once.
#[test]
fn damaged_files_end_at_once() {
    let Some(folder) = torture() else { return };
    let samples = folder.join("c3d/btkdata/Input/C3DSamples");
    let bases = ["c3d.org/sample02/pc_int.c3d", "c3d.org/sample02/sgi_real.c3d", "c3d.org/sample02/Dec_real.c3d", "others/MyCube.c3d"];
    let trc = folder.join("c3d/opensim-core/OpenSim/Common/Test/dataWithNaNsOfDifferentCases.trc");
    let scratch = tempfile::tempdir().unwrap();
    let mut random = 12345u32;
    let mut next = |below: usize| {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (random >> 8) as usize % below
    };
    let mut readable = 0;
    for (base, ending) in bases.iter().map(|b| (samples.join(b), "c3d")).chain([(trc, "trc")]) {
        let whole = std::fs::read(&base).unwrap();
        let path = scratch.path().join(format!("damaged.{ending}"));
        for trial in 0..300 {
            let mut bytes = whole.clone();
            if trial % 3 == 0 {
                bytes.truncate(next(whole.len()));
            } else {
                // Where sizes, counts and places are.
                (0..1 + trial % 5).for_each(|_| bytes[next(whole.len().min(3000))] = [0, 1, 127, 128, 255][next(5)]);
            }
            std::fs::write(&path, &bytes).unwrap();
            match read(&path) {
                Ok((markers, _)) => {
                    let points: usize = markers.frames.iter().map(Vec::len).sum();
                    // An integer point has 8 bytes, a number of a table at least 2 with its tab.
                    assert!(points * 2 <= bytes.len() && markers.names.len() <= bytes.len(), "{points} points of {} bytes", bytes.len());
                    readable += 1;
                }
                Err(error) => one_sentence(&error.to_string(), &path),
            }
        }
    }
    assert!(readable > 100, "{readable}");
}

#[test]
fn blanks_and_nans_of_tables_are_gaps() {
    let Some(folder) = torture() else { return };
    let test = folder.join("c3d/opensim-core/OpenSim/Common/Test");
    let gaps = |name: &str| {
        let (markers, notices) = read(&test.join(name)).unwrap();
        let all = markers.frames.iter().flatten().count();
        println!("{name}: {} markers, {} frames, {notices:?}", markers.names.len(), markers.frames.len());
        (markers.frames.iter().flatten().filter(|x| x.is_none()).count(), all, markers.metres_per_unit)
    };
    for name in ["dataWithBlanksForMissingMarkers.trc", "dataWithNaNsOfDifferentCases.trc", "dataWithNaNsWithSpaces.trc"] {
        let (missing, all, unit) = gaps(name);
        println!("{missing} of {all}");
        assert!(missing > 0 && missing < all && unit.is_some(), "{name}");
    }
    assert_eq!(gaps("dataWithEformat.trc").0, 0);
}
