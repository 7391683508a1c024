//! The commands `model` and `generate` as a user runs them, on the synthetic database.

use std::path::Path;

use crate::common::{path, run};

/// Speed over the floor of a written BVH, from its root channels alone.
fn root_speed_m_s(bvh: &Path) -> f64 {
    let text = std::fs::read_to_string(bvh).unwrap();
    let motion: Vec<&str> = text.split("MOTION").nth(1).unwrap().lines().filter(|l| !l.trim().is_empty()).collect();
    let frame_s: f64 = motion[1].trim_start_matches("Frame Time:").trim().parse().unwrap();
    let root = |line: &str| -> Vec<f64> { line.split_whitespace().take(3).map(|v| v.parse().unwrap()).collect() };
    let (first, last) = (root(motion[2]), root(motion[motion.len() - 1]));
    ((last[0] - first[0]).powi(2) + (last[2] - first[2]).powi(2)).sqrt() / (frame_s * (motion.len() - 3) as f64)
}

#[test]
fn a_synthetic_model_makes_motions_at_wanted_speeds() {
    let dir = tempfile::tempdir().unwrap();
    let model = path(dir.path(), "walking.npz");
    let (done, info, _) = run(&["model", "synthetic", "--activity", "walking", "-o", &model]);
    assert!(done && info.contains("synthetic walking, 324 cycles of 9 subjects"), "{info}");
    let first = std::fs::read(&model).unwrap();
    run(&["--threads", "1", "model", "synthetic", "--activity", "walking", "-o", &model]);
    assert!(std::fs::read(&model).unwrap() == first, "the same bytes every time and with one thread");
    assert_eq!(run(&["model", "info", &model]).1, info);

    // A generated walk is a motion file: it serves as the style of the next.
    let style = dir.path().join("style.json");
    let member = "synthetic_3";
    write_style(Path::new(&model), member, &style);
    let out = path(dir.path(), "out");
    let style = style.to_string_lossy().into_owned();
    let (done, _, error) = run(&["generate", "--model", &model, "--style", &style, "--at", "3km/h,1.1,1.7m/s", "-o", &out]);
    assert!(done, "{error}");
    for (name, speed) in [("walking_0.83.bvh", 3.0 / 3.6), ("walking_1.10.bvh", 1.1), ("walking_1.70.bvh", 1.7)] {
        let found = root_speed_m_s(&Path::new(&out).join(name));
        assert!((found / speed - 1.0).abs() < 0.01, "{name}: {found}");
    }
    let again = path(dir.path(), "again");
    let walk = path(Path::new(&out), "walking_1.10.bvh");
    let (done, said, error) = run(&[
        "generate",
        "--model",
        &model,
        "--style",
        &walk,
        "--at",
        "1.4",
        "--height",
        "1.5",
        "--fps",
        "30",
        "--seconds",
        "4",
        "-o",
        &again,
    ]);
    assert!(done && said.contains(&format!("nearest subject {member}")), "{said} {error}");
    let text = std::fs::read_to_string(Path::new(&again).join("walking_1.40.bvh")).unwrap();
    assert!(text.contains("Frames: 121"));
}

/// The style of a database subject at 1.25 m/s.
fn write_style(model: &Path, subject: &str, to: &Path) {
    use muybridge::io::model_npz::{model_hash, read_model};
    let model = read_model(model).unwrap();
    let own = |m: &&muybridge::motion_model::Member| m.subject == subject && (m.parameter - 4.5 / 3.6).abs() < 1e-9;
    let cycles: Vec<_> = model.members.iter().filter(own).map(|m| model.cycle_of(m)).collect();
    assert_eq!(cycles.len(), 4);
    let style = muybridge::style::Style::of_cycles(&model, &model_hash(&model), &cycles).unwrap();
    muybridge::io::style_json::write_style(to, &style).unwrap();
}

#[test]
fn wrong_input_is_one_sentence() {
    let dir = tempfile::tempdir().unwrap();
    let model = path(dir.path(), "m.npz");
    assert!(run(&["model", "synthetic", "--activity", "jumping", "-o", &model]).0);
    let bad = path(dir.path(), "bad.bvh");
    std::fs::write(&bad, "HIERARCHY\nROOT hips\n{\n  OFFSET 0 0 zero\n").unwrap();
    let nothing = path(dir.path(), "none");
    let folder = path(dir.path(), "");
    let cases: [(&[&str], &str); 6] = [
        (&["generate", "--model", &bad, "--style", &bad, "--at", "1", "-o", &nothing], "no model file"),
        (&["generate", "--model", &model, "--style", &bad, "--at", "1km/h", "-o", &nothing], "no positive number with a unit of jumping"),
        (&["generate", "--model", &model, "--style", &model, "--at", "1", "-o", &nothing], "no style file"),
        (&["model", "build", &folder, "--activity", "walking", "--exclude", "77", "-o", &nothing], "--exclude 77 matches no subject"),
        (&["model", "build", &folder, "--activity", "walking", "-o", &nothing], "none of 1 motions can be used for walking"),
        (&["model", "info", &nothing], "cannot read"),
    ];
    for (arguments, part) in cases {
        let (done, _, error) = run(arguments);
        let last = error.lines().last().unwrap_or_default();
        assert!(!done && last.starts_with("error: ") && last.contains(part), "{arguments:?}: {error}");
        assert!(!Path::new(&nothing).exists());
    }
}

#[test]
fn the_papers_ordering_emerges_from_the_synthetic_runners() {
    let dir = tempfile::tempdir().unwrap();
    let model = path(dir.path(), "m.npz");
    assert!(run(&["model", "synthetic", "--activity", "running", "-o", &model]).0);
    let (done, _, error) = run(&["model", "validate", &model, "-o", &path(dir.path(), "v")]);
    assert!(done, "{error}");
    let csv = std::fs::read_to_string(dir.path().join("v/validation.csv")).unwrap();
    assert!(csv.starts_with("method,metric,left_out,value\n"));
    let value = |start: &str| -> f64 { csv.lines().find_map(|l| l.strip_prefix(start)).unwrap().parse().unwrap() };
    let [intra, paper, inter] = ["intra", "paper", "inter"].map(|m| value(&format!("{m},eq6,all,")));
    assert!(intra < paper && paper < 0.6 * inter, "{intra} {paper} {inter}");
    assert!(value("paper,rms_deg,all,") < value("mean,rms_deg,all,"));
    // Every ordered pair of parameters has a line, and together they are what the table pools.
    let pairs = std::fs::read_to_string(dir.path().join("v/pairs.csv")).unwrap();
    let rows: Vec<Vec<&str>> = pairs.lines().skip(1).map(|l| l.split(',').collect()).collect();
    let deg: Vec<f64> = rows.iter().filter(|r| r[3] == "default").map(|r| r[4].parse().unwrap()).collect();
    assert!(deg.len() > 50 && rows.iter().all(|r| r[1] != r[2]), "{pairs}");
    let pooled = (deg.iter().map(|d| d * d).sum::<f64>() / deg.len() as f64).sqrt();
    assert!((pooled / value("default,rms_deg,all,") - 1.0).abs() < 1e-5, "{pooled}");
}
