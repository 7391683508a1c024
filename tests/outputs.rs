//! The files that `generate` writes beside each BVH, read by others' crates and plain rules.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
use muybridge::body::Joint;
use muybridge::io::model_npz::{model_hash, read_model};
use muybridge::io::style_json::write_style;
use muybridge::io::{glb, read_clip};
use muybridge::style::Style;

fn run(arguments: &[&str]) -> (bool, String) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    (output.status.success(), String::from_utf8_lossy(&output.stderr).into_owned())
}

/// A synthetic model and the style of one of its subjects at 1.25 m/s.
fn model_and_style(folder: &Path) -> (String, String) {
    let [model_path, style_path] = ["walking.npz", "style.json"].map(|n| folder.join(n).to_string_lossy().into_owned());
    assert!(run(&["model", "synthetic", "--activity", "walking", "-o", &model_path]).0);
    let model = read_model(Path::new(&model_path)).unwrap();
    let own = |m: &&muybridge::motion_model::Member| m.subject == "synthetic_2" && (m.parameter - 1.25).abs() < 1e-9;
    let cycles: Vec<_> = model.members.iter().filter(own).map(|m| model.cycle_of(m)).collect();
    write_style(Path::new(&style_path), &Style::of_cycles(&model, &model_hash(&model), &cycles).unwrap()).unwrap();
    (model_path, style_path)
}

fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut paths: Vec<PathBuf> = folder.read_dir().unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    paths.iter().map(|p| (p.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(p).unwrap())).collect()
}

#[test]
fn every_format_holds_the_same_motion() {
    let folder = tempfile::tempdir().unwrap();
    let (model, style) = model_and_style(folder.path());
    let out = folder.path().join("out");
    let generate = |threads: &str, out: &Path, more: &[&str]| {
        let out = out.to_string_lossy().into_owned();
        let first =
            ["--threads", threads, "generate", "--model", &model, "--style", &style, "--at", "1.0,1.5", "--cycles", "1", "-o", &out];
        run(&[&first[..], more].concat())
    };
    let recorded = folder.path().join("recorded");
    assert!(generate("2", &recorded, &[]).0);
    let over = recorded.join("walking_1.50.bvh").to_string_lossy().into_owned();
    // One cycle is too short to be recognised as a recording.
    let (done, error) = generate("2", &out, &["--strips", "--over", &over]);
    assert!(!done && error.contains("--over shows no whole cycle"), "{error}");
    let (done, error) = generate("2", &out, &["--strips", "7", "--bvh-order", "xyz"]);
    assert!(done, "{error}");
    let written = files(&out);
    let names: Vec<&str> = written.iter().map(|(name, _)| name.as_str()).collect();
    let of_value = ["bvh", "c3d", "glb", "json", "mot", "trc"];
    let mut expected: Vec<String> = ["1.00", "1.50"].iter().flat_map(|v| of_value.map(|e| format!("walking_{v}.{e}"))).collect();
    expected.extend(["generated.csv", "outputs.json", "report.html", "strips.png", "strips.svg", "walking.glb"].map(String::from));
    expected.sort();
    assert_eq!(names, expected);
    check_motions(&out);
    // The same bytes with one thread.
    let again = folder.path().join("again");
    assert!(generate("1", &again, &["--strips", "7", "--bvh-order", "xyz"]).0);
    for ((name, a), (_, b)) in written.iter().zip(&files(&again)) {
        assert!(a == b, "{name}");
    }
    assert!(!generate("1", &again, &["--bvh-order", "xyx"]).0);
}

fn check_motions(out: &Path) {
    let together = glb::read(&out.join("walking.glb")).unwrap();
    assert_eq!(together.motions.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(), ["walking_1.00", "walking_1.50"]);
    assert!(together.skin.triangles.len() > 10_000);
    let notes: serde_json::Value = serde_json::from_slice(&std::fs::read(out.join("outputs.json")).unwrap()).unwrap();
    assert_eq!(notes["files"].as_object().unwrap().len(), 11);
    assert_eq!(
        (&notes["files"]["walking_1.00.trc"]["length_unit"], &notes["files"]["walking.glb"]["source"]["motion"]),
        (&"mm".into(), &"style.json".into())
    );
    for (motion, stem) in together.motions.iter().zip(["walking_1.00", "walking_1.50"]) {
        let at = |ending: &str| out.join(format!("{stem}.{ending}"));
        let text = std::fs::read_to_string(at("bvh")).unwrap();
        assert!(text.contains("CHANNELS 3 Xrotation Yrotation Zrotation"));
        let clip = read_clip(&at("bvh")).unwrap().clip;
        let read = glb::read(&at("glb")).unwrap().motions;
        assert!(read.len() == 1 && read[0] == *motion);
        let c3d = c3dio::C3d::load_path(at("c3d")).unwrap();
        let column = c3d.points.labels.iter().position(|l| l.trim() == "l_wrist").unwrap();
        let trc = std::fs::read_to_string(at("trc")).unwrap();
        let trc: Vec<Vec<&str>> = trc.lines().map(|l| l.split('\t').collect()).collect();
        let first = trc[3].iter().position(|c| *c == "l_wrist").unwrap();
        let bone = together.bones.iter().position(|b| b.name == "l_wrist").unwrap();
        for (k, pose) in clip.poses.iter().enumerate() {
            let x = clip.place(pose).position(Joint::LWrist);
            let of_glb = together.world_from_bones(&motion.postures[k])[bone].column(3).xyz();
            let [a, b, c] = c3d.points.points[(k, column)].point.map(|v| f64::from(v) / 1e3);
            let [d, e, f] = [0, 1, 2].map(|n| trc[6 + k][first + n].parse::<f64>().unwrap() / 1e3);
            let places = [of_glb, nalgebra::Vector3::new(b, c, a), nalgebra::Vector3::new(-f, e, d)];
            assert!(places.iter().all(|p| (p - x).norm() < 1e-5), "{stem} frame {k}: {x:?} {places:?}");
        }
        // Hip and knee of the MOT, which knows no lengths, as the reader takes it.
        let angles = read_clip(&at("mot")).unwrap().clip;
        for (a, b) in angles.poses.iter().zip(&clip.poses) {
            let off = [Joint::LHip, Joint::RHip, Joint::LKnee, Joint::RKnee].map(|j| a.joint(j).angle_to(b.joint(j)).to_degrees());
            assert!(off.iter().all(|o| *o < 3.0), "{off:?}");
        }
    }
}

#[test]
fn a_folder_of_outputs_counts_every_motion_once() {
    use muybridge::io::manifest::find_motions;
    let folder = tempfile::tempdir().unwrap();
    let (model, style) = model_and_style(folder.path());
    let out = folder.path().join("out");
    let (done, error) = run(&["generate", "--model", &model, "--style", &style, "--at", "1.2", "-o", &out.to_string_lossy()]);
    assert!(done, "{error}");
    let found = find_motions(std::slice::from_ref(&out), None).unwrap();
    assert_eq!(found.len(), 1);
    assert!(found[0].path.ends_with("walking_1.20.bvh"));
    // Four cycles are enough to be drawn below what is generated from them.
    let (again, walk) = (folder.path().join("again"), found[0].path.to_string_lossy().into_owned());
    let (done, error) = run(&[
        "generate",
        "--model",
        &model,
        "--style",
        &walk,
        "--at",
        "1.2,1.6",
        "--strips",
        "--over",
        &walk,
        "--over",
        "nearest",
        "-o",
        &again.to_string_lossy(),
    ]);
    assert!(done, "{error}");
    let svg = std::fs::read_to_string(again.join("strips.svg")).unwrap();
    // The recording below the person's own row and the generated one of its speed: nine pale figures each, and the legend's line.
    assert_eq!(svg.matches("stroke-width=\"6\"").count(), 2 * 9 * 27 + 1);
    assert!(svg.contains(">recorded</text>"));
    // The nearest person of the database walks at every speed.
    let svg = std::fs::read_to_string(again.join("strips_nearest.svg")).unwrap();
    assert_eq!(svg.matches("stroke-width=\"6\"").count(), 3 * 9 * 27 + 1);
    assert!(svg.contains(", nearest of the database by equation 6</text>"));
}
