//! Every report page in a headless Chromium: pictures load, nothing is fetched, nothing overflows on a telephone, light and
//! dark, names are shown and not run, the view turns. The numbers beside a page agree with the footage's truth.

use std::path::{Path, PathBuf};

use crate::browser::Browser;
use assert_cmd::Command;
use muybridge::animal::horse::{Gait, horse, posture};
use muybridge::animal::render::{View, silhouette};
use muybridge::io::{bvh, model_npz};
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, Cycle, Model, synthetic};
use muybridge::report::study::{self, Study, StudyRow};
use serde_json::{Value, json};

/// Runs as a page's text; would run as a script.
const NASTY: &str = "<script>alert(1)<!-- \"Müller's\" & <b>co";
const SPEED_M_S: f64 = 1.3;

fn run(arguments: &[&str]) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// A small database whose subjects have nasty names.
fn model(path: &Path) {
    let cycle =
        |seed: u64, speed: f64| Cycle { subject: format!("{seed} {NASTY}"), ..synthetic::subject(Activity::Walking, seed).cycle(speed, 0) };
    let cycles: Vec<Cycle> = (1..=5).flat_map(|seed| [0.9, 1.3, 1.7].map(|speed| cycle(seed, speed))).collect();
    model_npz::write_model(path, &Model::build(Activity::Walking, true, &cycles).unwrap()).unwrap();
}

/// Footage of a synthetic person; the cycle that was filmed.
fn film(folder: &Path, session: &str) -> Cycle {
    let subject = synthetic::subject(Activity::Walking, 3);
    let cycle = subject.mean_cycle(SPEED_M_S);
    let clip = play_cycle(&cycle, &subject.shape().offsets(), 30.0, Length::Seconds(1.1));
    let motion = folder.join("walk.bvh");
    bvh::write_clip(&motion, &clip, None).unwrap();
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml");
    let stature = subject.stature_m.to_string();
    run(&["render", motion.to_str().unwrap(), "--rig", rig.to_str().unwrap(), "--stature", &stature, "-o", session]);
    cycle
}

/// A horse's silhouettes, and what `animal run` makes of them.
fn animal(folder: &Path) -> PathBuf {
    let horse = horse();
    let view = View::side(&horse, [160, 120]);
    let masks = folder.join("masks");
    std::fs::create_dir_all(&masks).unwrap();
    for t in 0..40 {
        let mask = silhouette(&horse, &posture(&horse, Gait::Canter, f64::from(t) / 16.0), &view);
        mask.save(masks.join(format!("{t:06}.png"))).unwrap();
    }
    let study = folder.join(format!("{}.toml", NASTY.replace('/', "")));
    std::fs::write(&study, "masks = \"masks\"\noutput = \"animal\"\n").unwrap();
    run(&["animal", "run", study.to_str().unwrap()]);
    folder.join("animal/report.html")
}

fn study_page(folder: &Path, thumbnail: &[u8]) -> PathBuf {
    let row = |session, state, reason, value: &str| StudyRow {
        session,
        state,
        reason,
        report: (state == "done").then_some("tracked/report.html"),
        thumbnail: (state == "done").then_some(thumbnail),
        values: vec![value.to_string(), "30".to_string()],
    };
    let rows = vec![
        row("walk_2", "done", None, "1.25"),
        row("walk_10", "done", None, "0.9"),
        row(NASTY, "failed", Some("cam_01 has 3 pictures fewer than cam_00"), ""),
        row("walk_1", "pending", None, ""),
    ];
    let page = study::html(&Study { title: NASTY, columns: vec!["speed (m/s)", "frames"], rows });
    let path = folder.join("index.html");
    std::fs::write(&path, page).unwrap();
    path
}

struct Reader {
    browser: Browser,
}

impl Reader {
    fn emulate(&self, width: u32, scheme: &str) {
        let execute = |cmd: &str, params: Value| self.browser.call("POST", "/goog/cdp/execute", json!({ "cmd": cmd, "params": params }));
        execute("Emulation.setDeviceMetricsOverride", json!({ "width": width, "height": 900, "deviceScaleFactor": 1, "mobile": false }));
        execute("Emulation.setEmulatedMedia", json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }] }));
    }

    fn open(&self, page: &Path) {
        let address = page.to_str().unwrap().bytes().fold(String::from("file://"), |mut text, byte| {
            if byte.is_ascii_alphanumeric() || b"/._-".contains(&byte) {
                text.push(char::from(byte));
            } else {
                text += &format!("%{byte:02X}");
            }
            text
        });
        self.browser.call("POST", "/url", json!({ "url": address }));
    }

    /// Everything that holds for every page.
    fn check(&self, page: &Path) {
        for (width, scheme) in [(1280, "light"), (1280, "dark"), (390, "light"), (390, "dark")] {
            self.emulate(width, scheme);
            self.open(page);
            self.browser.wait("document.readyState === 'complete' && [...document.images].every(i => i.complete)");
            let said = self.browser.script(
                "const luminance = c => c.match(/[0-9.]+/g).slice(0, 3).reduce((s, v, k) => s + v * [0.21, 0.72, 0.07][k], 0);
                 const style = getComputedStyle(document.body), seen = [...document.querySelectorAll('[src],[href]')];
                 return {
                   broken: [...document.images].filter(i => i.naturalWidth === 0).length, pictures: document.images.length,
                   fetched: performance.getEntriesByType('resource').map(e => e.name),
                   outside: seen.map(e => e.getAttribute('src') ?? e.getAttribute('href')).filter(a => !/^(data:image\\/|#|\\.\\/)/.test(a)),
                   overflow: document.documentElement.scrollWidth - innerWidth, paper: luminance(style.backgroundColor),
                   ink: luminance(style.color), text: document.body.innerText, bold: document.querySelectorAll('b').length,
                   first: document.querySelector('header .verdict') !== null,
                 };",
            );
            let place = format!("{} at {width} {scheme}", page.display());
            assert_eq!((&said["broken"], &said["fetched"], &said["outside"]), (&json!(0), &json!([]), &json!([])), "{place}");
            assert!(said["overflow"].as_i64().unwrap() <= 0, "{place}: {}", said["overflow"]);
            let (paper, ink) = (said["paper"].as_f64().unwrap(), said["ink"].as_f64().unwrap());
            assert!(if scheme == "light" { paper > 240.0 && ink < 60.0 } else { paper < 60.0 && ink > 200.0 }, "{place}: {paper} {ink}");
            assert!(said["text"].as_str().unwrap().contains(NASTY) && said["bold"] == json!(0) && said["first"] == json!(true), "{place}");
        }
        let log = self.browser.call("POST", "/se/log", json!({ "type": "browser" }));
        let errors: Vec<&Value> = log.as_array().unwrap().iter().filter(|l| l["level"] == json!("SEVERE")).collect();
        assert!(errors.is_empty(), "{}: {errors:?}", page.display());
    }

    fn numbers(&self, script: &str) -> Vec<f64> {
        self.browser.script(script).as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
    }
}

/// Opens the view, turns it with the mouse, and goes to another frame.
fn turn_about(reader: &Reader, page: &Path) {
    let browser = &reader.browser;
    reader.emulate(1280, "light");
    reader.open(page);
    assert_eq!(browser.script("return typeof Plotly;"), json!("undefined"), "the script waits until it is wanted");
    browser.click("#view3d summary");
    browser.wait("document.getElementById('view3d-plot').dataset.frame === '0'");
    let eye = "const e = document.getElementById('view3d-plot')._fullLayout.scene._scene.getCamera().eye; return [e.x, e.y, e.z];";
    let label = "return document.getElementById('view3d-label').textContent;";
    let (before, first) = (reader.numbers(eye), browser.script(label));
    browser.script("document.getElementById('view3d').scrollIntoView();");
    let at = reader.numbers(
        "const r = document.getElementById('view3d-plot').getBoundingClientRect(); return [r.left + r.width / 2, r.top + r.height / 2];",
    );
    browser.drag(&[[at[0], at[1]], [at[0] + 60.0, at[1] + 10.0], [at[0] + 160.0, at[1] + 30.0]]);
    let turned: f64 = reader.numbers(eye).iter().zip(&before).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    assert!(turned > 0.2, "{before:?} {:?}", reader.numbers(eye));
    let nodes = "const b = document.getElementById('view3d-plot').data[1]; return [b.x[0], b.y[0], b.z[0]];";
    let was = reader.numbers(nodes);
    // The middle of the slider.
    browser.click("#view3d-time");
    browser.wait("Number(document.getElementById('view3d-plot').dataset.frame) > 3");
    assert!(browser.script(label) != first);
    let gone: f64 = reader.numbers(nodes).iter().zip(&was).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    assert!((0.2..1.5).contains(&gone), "{gone} m in half the take");
    // The reader's turn of the view stays.
    let kept: f64 = reader.numbers(eye).iter().zip(&before).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
    assert!(kept > 0.2);
    let traces = browser.script("return document.getElementById('view3d-plot').data.map(t => t.name);");
    assert_eq!(traces, json!(["body", "left", "right", "trunk", "cloud"]));
}

/// gait.csv against the filmed cycle.
fn numbers_agree(folder: &Path, cycle: &Cycle) {
    let text = std::fs::read_to_string(folder.join("gait.csv")).unwrap();
    let value = |measure: &str, side: &str| -> f64 {
        let row = text.lines().find(|l| l.starts_with(&format!("cycle,{measure},")) && l.contains(&format!(",{side},")));
        row.unwrap_or_else(|| panic!("{measure} {side}: {text}")).split(',').nth(4).unwrap().parse().unwrap()
    };
    assert!((value("cadence", "both") * cycle.duration_s / 120.0 - 1.0).abs() < 0.06, "{text}");
    assert!((value("stride length", "both") / (SPEED_M_S * cycle.duration_s) - 1.0).abs() < 0.06, "{text}");
    assert!((value("step length", "left") + value("step length", "right") - value("stride length", "both")).abs() < 0.03, "{text}");
    let angles = std::fs::read_to_string(folder.join("angles_cycle.csv")).unwrap();
    assert!(angles.lines().filter(|l| l.starts_with("cycle,left,") || l.starts_with("cycle,right,")).count() == 202);
    assert!(std::fs::read(folder.join("thumbnail.jpg")).unwrap().starts_with(&[0xff, 0xd8]));
}

#[test]
fn every_page_is_whole_harmless_and_readable() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let text = |name: &str| path(name).to_str().unwrap().to_string();
    let (session, database) = (text(NASTY), text(&format!("{NASTY}.npz")));
    model(Path::new(&database));
    let cycle = film(dir.path(), &session);
    run(&["track", &session, "--model", &database, "-o", &text("tracked")]);
    numbers_agree(&path("tracked"), &cycle);
    run(&["generate", "--model", &database, "--style", &text("tracked/style.json"), "--at", "1.0,1.3,1.6", "-o", &text("generated")]);
    run(&["model", "validate", &database, "-o", &text("validated")]);
    let thumbnail = std::fs::read(path("tracked/thumbnail.jpg")).unwrap();
    let reader = Reader { browser: Browser::open(dir.path(), &["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]) };
    let study = study_page(dir.path(), &thumbnail);
    let tracked = path("tracked/report.html");
    for page in [&tracked, &path("generated/report.html"), &path("validated/report.html"), &animal(dir.path()), &study] {
        reader.check(page);
    }
    turn_about(&reader, &tracked);

    // The study's rows are sorted by a click, numbers as numbers.
    reader.open(&study);
    let names = "return [...document.querySelectorAll('#study tbody tr')].map(r => r.cells[1].textContent);";
    assert_eq!(reader.browser.script(names)[0], json!(NASTY));
    reader.browser.click("#study th:nth-child(2) button");
    assert_eq!(reader.browser.script(names), json!([NASTY, "walk_1", "walk_2", "walk_10"]));
    reader.browser.click("#study th:nth-child(5) button");
    assert_eq!(reader.browser.script(names), json!(["walk_10", "walk_2", NASTY, "walk_1"]));
    reader.browser.click("#study tbody a");
    reader.browser.wait("document.querySelector('.kicker')?.textContent === 'muybridge track'");
    reader.browser.call("DELETE", "", json!({}));
}
