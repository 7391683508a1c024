//! The animal pipeline as a zoologist runs it, on a rendered horse: masks, verdict, keys, poses, animation; wrong input.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::common::run;
use image::{GrayImage, Rgb, RgbImage};
use muybridge::animal::creature::{Creature, Local, Motion, Posture};
use muybridge::animal::horse::{Gait, horse};
use muybridge::animal::render::{View, shaded, silhouette};
use muybridge::animal::study::angle_error;
use muybridge::io::{creature_bvh, glb};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SIZE: [u32; 2] = [240, 180];

fn fine(arguments: &[&str]) -> String {
    let (done, out, error) = run(arguments);
    assert!(done, "{arguments:?}: {error}");
    out
}

/// The sentence of a command that must fail.
fn refused(arguments: &[&str]) -> String {
    let (done, _, error) = run(arguments);
    assert!(!done, "{arguments:?}");
    let sentences: Vec<&str> = error.lines().filter(|l| l.starts_with("error:")).collect();
    assert_eq!(sentences.len(), 1, "{error}");
    sentences[0].to_string()
}

/// A horse that crosses a meadow under a following camera: frames, silhouettes, postures on the spot.
fn film(folder: &Path, gait: Gait, frames: usize) -> (Vec<GrayImage>, Vec<Posture>) {
    let horse = horse();
    let view = View::side(&horse, SIZE);
    let motion = horse.motions.iter().find(|m| m.name == gait.name()).unwrap();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    // Blotches of grass and sky, wider than the clip's way.
    let ground: Vec<f64> = (0..1200 * 180).map(|_| random.random::<f64>()).collect();
    let blotch = |x: usize, y: usize| {
        (0..3)
            .flat_map(|dy| (0..3).map(move |dx| (dx, dy)))
            .map(|(dx, dy)| ground[(y / 4 * 4 + dy) % 180 * 1200 + (x / 4 * 4 + dx) % 1200])
            .sum::<f64>()
            / 9.0
    };
    let (mut masks, mut postures) = (Vec::new(), Vec::new());
    for t in 0..frames {
        let posture = motion.at((t as f64 / 25.0).rem_euclid(motion.duration_s())).unwrap();
        let (mask, body) = (silhouette(&horse, &posture, &view), shaded(&horse, &posture, &view, [0; 3]));
        let picture = RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| {
            let noise = 5.0 * (random.random::<f64>() - 0.5);
            let colour = if mask.get_pixel(x, y).0[0] > 0 {
                body.get_pixel(x, y).0.map(f64::from)
            } else {
                let v = blotch(x as usize + 4 * t, y as usize) * 90.0 - 45.0;
                if y < 70 { [130.0 + v, 165.0 + v, 205.0 + v] } else { [95.0 + v, 140.0 + v, 75.0 + v] }
            };
            Rgb(colour.map(|c| (c + noise).clamp(0.0, 255.0) as u8))
        });
        std::fs::create_dir_all(folder).unwrap();
        picture.save(folder.join(format!("{t}.png"))).unwrap();
        masks.push(mask);
        postures.push(posture);
    }
    (masks, postures)
}

/// A rectangle inside the trunk, and three beside the animal.
fn rectangles() -> Vec<String> {
    let view = View::side(&horse(), SIZE);
    let [low, high] = horse().bounds().unwrap();
    let (a, b) = (view.pixel(&low), view.pixel(&high));
    let (left, right, top) = (a.x as u32, b.x as u32, b.y as u32);
    let trunk = view.pixel(&nalgebra::Vector3::new(0.0, 1.35, -0.3));
    vec![
        "--subject".into(),
        format!("{},{},{},14", trunk.x as u32 - 8, trunk.y as u32 - 6, 50),
        "--background".into(),
        format!("0,0,{},180", left - 12),
        "--background".into(),
        format!("{},0,{},180", right + 12, SIZE[0] - right - 12),
        "--background".into(),
        format!("0,0,{},{}", SIZE[0], top - 8),
    ]
}

/// `animal masks` by `way`: one that must succeed, or must not.
fn masks_by(first: &[&str], clip: &str, marks: &[String], output: &str, way: fn(&[&str]) -> String) -> String {
    let marks: Vec<&str> = marks.iter().map(String::as_str).collect();
    way(&[first, &["animal", "masks", clip], &marks, &["-o", output]].concat())
}

fn iou(a: &GrayImage, b: &GrayImage) -> f64 {
    let count = |f: fn(bool, bool) -> bool| a.iter().zip(b.iter()).filter(|(a, b)| f(**a > 0, **b > 0)).count() as f64;
    count(|a, b| a && b) / count(|a, b| a || b)
}

/// Every file below a folder by its relative name.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(at) = open.pop() {
        for entry in at.read_dir().unwrap().map(|e| e.unwrap().path()) {
            if entry.is_dir() {
                open.push(entry)
            } else {
                found.insert(entry.strip_prefix(folder).unwrap().to_path_buf(), std::fs::read(&entry).unwrap());
            }
        }
    }
    found
}

/// A posture of the horse on a skeleton that holds its bones among others.
fn set_on(template: &Creature, horse: &Creature, posture: &[Local]) -> Posture {
    let of = |name: &str| horse.bones.iter().position(|b| b.name == name).map(|k| posture[k]);
    template.bones.iter().map(|b| of(&b.name).unwrap_or(b.rest)).collect()
}

fn key_frames(folder: &Path) -> Vec<usize> {
    let record: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(folder.join("keys.json")).unwrap()).unwrap();
    record["keys"].as_array().unwrap().iter().map(|k| k.as_u64().unwrap() as usize).collect()
}

#[test]
fn a_canter_goes_from_rectangles_to_an_animation_near_the_truth_with_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (truth, postures) = film(&dir.path().join("clip"), Gait::Canter, 64);
    let marks = rectangles();
    for threads in ["1", "4"] {
        masks_by(&["--threads", threads], &at("clip"), &marks, &at(&format!("masks{threads}")), fine);
    }
    let (one, four) = (files(&dir.path().join("masks1")), files(&dir.path().join("masks4")));
    assert!(one == four && one.keys().filter(|k| k.extension().is_some_and(|e| e == "png")).count() == 64);
    let mean = truth
        .iter()
        .enumerate()
        .map(|(t, m)| iou(m, &image::open(dir.path().join(format!("masks1/{t:06}.png"))).unwrap().into_luma8()))
        .sum::<f64>()
        / 64.0;
    println!("masks: IoU {mean:.3}");
    assert!(mean > 0.88, "{mean}");

    let table = fine(&["animal", "analyse", &at("masks1"), "--fps", "25", "-o", &at("analysis")]);
    assert!(table.contains("verdict: usable") && table.contains("a silhouette every 16.0 frames"), "{table}");
    assert!(fine(&["animal", "keys", &at("analysis"), "-o", &at("keys")]).contains("the smallest there is"));
    let keys = key_frames(&dir.path().join("keys"));
    assert_eq!(keys.len(), 4);

    // The artist's poses, set on the template: the truth, through GLB and through BVH.
    let mut template = glb::read(&dir.path().join("keys/template.glb")).unwrap();
    assert_eq!(template.motions[0].postures.len(), 4);
    let horse = horse();
    let posed: Vec<Posture> = keys.iter().map(|k| set_on(&template, &horse, &postures[*k])).collect();
    template.motions = vec![Motion::at_rate("keys", 24.0, posed.clone())];
    glb::write(&dir.path().join("poses.glb"), &template).unwrap();
    creature_bvh::write(&dir.path().join("poses.bvh"), &template, &posed, 24.0).unwrap();
    for (poses, out) in [("poses.glb", "a"), ("poses.bvh", "b")] {
        fine(&["animal", "animate", &at("analysis"), &at("keys"), "--poses", &at(poses), "--travel", "none", "-o", &at(out)]);
        let animated = glb::read(&dir.path().join(out).join("motion.glb")).unwrap();
        assert_eq!(animated.motions[0].postures.len(), 64);
        let found: Vec<Posture> = animated.motions[0].postures.iter().map(|p| horse.posture_from(&animated, p).unwrap()).collect();
        let error = angle_error(&horse, &postures, &found);
        println!("{poses}: {:.2} degrees", error.mean_deg);
        assert!(error.mean_deg < 4.5, "{error:?}");
    }
    let csv = std::fs::read_to_string(dir.path().join("a/weights.csv")).unwrap();
    let sums: Vec<f64> = csv.lines().skip(1).map(|l| l.rsplit(',').next().unwrap().parse().unwrap()).collect();
    assert!(sums.len() == 64 && sums.iter().all(|s| (s - 1.0).abs() < 0.5));
    // Another take of the same species needs no new poses.
    fine(&[
        "animal",
        "transfer",
        &at("analysis"),
        &at("keys"),
        &at("masks4"),
        "--poses",
        &at("poses.glb"),
        "--fps",
        "25",
        "--travel",
        "feet",
        "-o",
        &at("again"),
    ]);
    let again = glb::read(&dir.path().join("again/motion.glb")).unwrap();
    let found: Vec<Posture> = again.motions[0].postures.iter().map(|p| horse.posture_from(&again, p).unwrap()).collect();
    assert!(angle_error(&horse, &postures, &found).mean_deg < 5.0);

    // Poses of another number, and of another skeleton.
    template.motions[0].postures.truncate(3);
    template.motions[0].times_s.truncate(3);
    glb::write(&dir.path().join("three.glb"), &template).unwrap();
    let error = refused(&["animal", "animate", &at("analysis"), &at("keys"), "--poses", &at("three.glb"), "-o", &at("c")]);
    assert!(error.contains("3 frames where the template has 4"), "{error}");
    template.motions = vec![Motion::at_rate("keys", 24.0, posed)];
    let neck = template.bones.iter().position(|b| b.name == "neck_2").unwrap();
    template.bones[neck].name = "tentacle".into();
    glb::write(&dir.path().join("other.glb"), &template).unwrap();
    let error = refused(&["animal", "animate", &at("analysis"), &at("keys"), "--poses", &at("other.glb"), "-o", &at("c")]);
    assert!(error.contains("other.glb") && error.contains("another skeleton"), "{error}");
    assert!(!dir.path().join("c").exists());
}

#[test]
fn a_study_file_does_everything_and_repeats_only_what_changed() {
    let dir = tempfile::tempdir().unwrap();
    let (_, postures) = film(&dir.path().join("clip"), Gait::Walk, 64);
    let marks = rectangles();
    let list = |name: &str| marks.chunks(2).filter(|p| p[0] == name).map(|p| format!("{:?}", p[1])).collect::<Vec<_>>().join(", ");
    let study = dir.path().join("walk.toml");
    let head = format!(
        "video = \"clip\"\noutput = \"out\"\n[silhouettes]\nsubject = [{}]\nbackground = [{}]\n[analyse]\nfps = 25.0\n[keys]\ndouble = true\n",
        list("--subject"),
        list("--background")
    );
    std::fs::write(&study, &head).unwrap();
    let study = study.to_str().unwrap();
    let first = fine(&["animal", "run", study]);
    assert!(first.contains("next: set a pose on every frame"), "{first}");
    let out = dir.path().join("out");
    let keys = key_frames(&out.join("keys"));
    assert_eq!(keys.len(), 8);
    let mut horse = horse();
    horse.motions = vec![Motion::at_rate("keys", 24.0, keys.iter().map(|k| postures[*k].clone()).collect())];
    glb::write(&dir.path().join("poses.glb"), &horse).unwrap();
    std::fs::write(study, format!("{head}[animate]\nposes = \"poses.glb\"\ntravel = \"none\"\n")).unwrap();
    let second = fine(&["animal", "run", study]);
    assert!(["masks", "analysis", "keys"].iter().all(|s| second.contains(&format!("{s}: unchanged"))), "{second}");
    let animated = glb::read(&out.join("animation/motion.glb")).unwrap();
    let found: Vec<Posture> = animated.motions[0].postures.iter().map(|p| horse.posture_from(&animated, p).unwrap()).collect();
    let error = angle_error(&horse, &postures, &found);
    println!("walk end to end: {:.2} degrees", error.mean_deg);
    assert!(error.mean_deg < 4.0, "{error:?}");
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    let pictures = page.matches("data:image/png;base64,").count();
    assert!(pictures >= 6 && page.contains("a silhouette every") && page.contains("<svg") && !page.contains("src=\"http"), "{pictures}");
    let third = fine(&["animal", "run", study]);
    assert!(third.contains("animation: unchanged"));
    std::fs::write(study, format!("{head}[animate]\nposes = \"poses.glb\"\nclamp = true\n")).unwrap();
    let fourth = fine(&["animal", "run", study]);
    assert!(fourth.contains("keys: unchanged") && !fourth.contains("animation: unchanged"));
    std::fs::write(study, head.replace("double", "doubel")).unwrap();
    assert!(refused(&["animal", "run", study]).contains("doubel"));
}

#[test]
fn proposals_are_rejected_and_named() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (masks, _) = film(&dir.path().join("clip"), Gait::Walk, 80);
    muybridge::io::animal_clip::write_masks(&dir.path().join("masks"), &masks).unwrap();
    fine(&["animal", "analyse", &at("masks"), "--fps", "25", "-o", &at("analysis")]);
    fine(&["animal", "keys", &at("analysis"), "--double", "-o", &at("keys")]);
    let alternates = || -> Vec<(u64, u64)> {
        let record: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(dir.path().join("keys/keys.json")).unwrap()).unwrap();
        record["alternates"].as_array().unwrap().iter().map(|a| (a["key"].as_u64().unwrap(), a["frame"].as_u64().unwrap())).collect()
    };
    let first = alternates();
    // Half a stride, 13 frames, or three halves.
    assert!(first.iter().all(|(k, f)| [13, 39, 66].iter().any(|d| k.abs_diff(*f).abs_diff(*d) <= 4)), "{first:?}");
    let reject = first[1].1.to_string();
    fine(&["animal", "keys", &at("analysis"), "--double", "--reject", &reject, "-o", &at("keys")]);
    let second = alternates();
    assert!(second[1].1 != first[1].1 && second[0] == first[0]);
    let named = format!("{}={}", first[0].0, if first[0].1 > 40 { first[0].1 - 1 } else { first[0].1 + 1 });
    fine(&["animal", "keys", &at("analysis"), "--double", "--alternate", &named, "-o", &at("keys")]);
    assert_eq!(format!("{}={}", alternates()[0].0, alternates()[0].1), named);
    assert!(dir.path().join("keys/alternates.png").exists() && dir.path().join("keys/template.bvh").exists());
    assert!(refused(&["animal", "keys", &at("analysis"), "--double", "--alternate", "999=3", "-o", &at("keys")]).contains("999 is no key"));
    assert!(refused(&["animal", "keys", &at("analysis"), "--keys", "64", "--components", "1", "-o", &at("other")]).starts_with("error:"));
}

#[test]
fn bad_clips_end_with_one_sentence() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (masks, _) = film(&dir.path().join("clip"), Gait::Gallop, 12);
    let outside = refused(&["animal", "masks", &at("clip"), "--subject", "230,0,50,20", "--background", "0,0,20,20", "-o", &at("m")]);
    assert!(outside.contains("230,0,50,20 on frame 0 is not inside the 240x180 picture"), "{outside}");
    let late = refused(&["animal", "masks", &at("clip"), "--subject", "40:100,80,20,20", "--background", "0,0,20,20", "-o", &at("m")]);
    assert!(late.contains("frame 40") && late.contains("last frame is 11"), "{late}");
    assert!(
        refused(&["animal", "masks", &at("nothing"), "--subject", "1,1,5,5", "--background", "0,0,20,20", "-o", &at("m")])
            .contains("nothing")
    );
    assert!(!dir.path().join("m").exists());
    let occupied = dir.path().join("thesis");
    std::fs::create_dir(&occupied).unwrap();
    std::fs::write(occupied.join("thesis.txt"), "years").unwrap();
    let marks = rectangles();
    let error = masks_by(&[], &at("clip"), &marks, &at("thesis"), refused);
    assert!(error.contains("is no folder of `muybridge animal masks`"), "{error}");
    assert_eq!(std::fs::read_to_string(occupied.join("thesis.txt")).unwrap(), "years");

    // An empty mask in the middle, one frame, a still animal, a clip without rhythm.
    let write = |name: &str, masks: &[GrayImage]| muybridge::io::animal_clip::write_masks(&dir.path().join(name), masks).unwrap();
    let mut gap = masks.clone();
    gap[5] = GrayImage::new(SIZE[0], SIZE[1]);
    write("gap", &gap);
    write("one", &masks[..1]);
    write("still", &vec![masks[0].clone(); 8]);
    let analyse = |name: &str| refused(&["animal", "analyse", &at(name), "--fps", "25", "-o", &at("a")]);
    assert!(analyse("gap").contains("frame 5 has no silhouette"));
    assert!(analyse("one").contains("1 silhouettes are too few"));
    assert!(analyse("still").contains("nothing moves"));
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let blobs: Vec<GrayImage> = (0..40)
        .map(|_| {
            let [a, b, c]: [f64; 3] = std::array::from_fn(|_| random.random::<f64>());
            GrayImage::from_fn(90, 70, |x, y| {
                let (x, y) = (f64::from(x) - 45.0, f64::from(y) - 35.0);
                image::Luma([if (x / (12.0 + 12.0 * a)).powi(2) + (y / (10.0 + 9.0 * b)).powi(2) + 0.001 * c * x * y < 1.0 {
                    255
                } else {
                    0
                }])
            })
        })
        .collect();
    write("blobs", &blobs);
    let table = fine(&["animal", "analyse", &at("blobs"), "--fps", "25", "-o", &at("a")]);
    assert!(table.contains("verdict: sketch"), "{table}");
    let table = fine(&["animal", "analyse", &at("blobs"), "--strokes", "--fps", "25", "-o", &at("a")]);
    assert!(table.contains("verdict: not usable"), "{table}");
    // Two animals: a notice, and the larger one is followed.
    let two: Vec<GrayImage> = masks.iter().map(|m| GrayImage::from_fn(2 * SIZE[0], SIZE[1], |x, y| *m.get_pixel(x % SIZE[0], y))).collect();
    write("two", &two);
    let (done, _, notices) = run(&["animal", "analyse", &at("two"), "--fps", "25", "-o", &at("a")]);
    assert!(done && notices.contains("second region"), "{notices}");
    assert!(refused(&["animal", "keys", &at("two"), "-o", &at("k")]).contains("analysis.json"));
}

/// Mean intersection over union with the hand-made masks of a clip; rectangles from the first true mask, as a user would draw.
fn real_clip(name: &str, more: &[&str]) -> Option<f64> {
    let clip = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/animal/clips/davis").join(name);
    let Ok(entries) = clip.join("masks").read_dir() else {
        println!("skipped: no {}", clip.display());
        return None;
    };
    let mut truths: Vec<PathBuf> = entries.map(|e| e.unwrap().path()).collect();
    truths.sort();
    let truth = |path: &PathBuf| image::open(path).unwrap().into_luma8();
    let first = truth(&truths[0]);
    let on: Vec<(u32, u32)> = first.enumerate_pixels().filter(|(_, _, p)| p.0[0] > 0).map(|(x, y, _)| (x, y)).collect();
    let range = |k: fn(&(u32, u32)) -> u32| (on.iter().map(k).min().unwrap(), on.iter().map(k).max().unwrap());
    let ((x0, x1), (y0, y1)) = (range(|p| p.0), range(|p| p.1));
    let (width, height) = first.dimensions();
    let inner = format!("{},{},{},{}", x0 + (x1 - x0) / 5, y0 + (y1 - y0) / 5, (x1 - x0) * 3 / 5, (y1 - y0) * 2 / 5);
    let beside =
        [format!("0,0,{},{height}", x0 - 4), format!("{},0,{},{height}", x1 + 4, width - x1 - 4), format!("0,0,{width},{}", y0 - 4)];
    let dir = tempfile::tempdir().unwrap();
    let (images, out) = (clip.join("images"), dir.path().join("masks"));
    let mut command = vec!["animal", "masks", images.to_str().unwrap(), "--subject", &inner, "-o", out.to_str().unwrap()];
    beside.iter().for_each(|b| command.extend(["--background", b]));
    fine(&[&command[..], more].concat());
    let scores =
        truths.iter().enumerate().map(|(t, path)| iou(&truth(path), &image::open(out.join(format!("{t:06}.png"))).unwrap().into_luma8()));
    Some(scores.sum::<f64>() / truths.len() as f64)
}

#[test]
fn real_animals_before_a_following_camera_are_found() {
    for (name, still_at_most) in [("camel", 0.7), ("lucia", 1.0)] {
        let (Some(found), Some(still)) = (real_clip(name, &[]), real_clip(name, &["--motion", "off"])) else { continue };
        println!("{name}: IoU {found:.3}, without motion {still:.3}");
        assert!(found > 0.8 && still < still_at_most, "{name}: {found} {still}");
    }
}
