//! The sketch page in a headless Chromium, driven through WebDriver: strokes, onion skin, copy, undo, boxes, saving; and who
//! is not answered. `.ci/install` installs Chromium and its driver.

use std::path::Path;
use std::process::Command;

use crate::browser::{Browser, http, started};
use image::{Rgb, RgbImage};
use serde_json::{Value, json};

/// Draws with the mouse along points of the video's pixels.
fn draw(browser: &Browser, points: &[[f64; 2]]) {
    let scale = "const r = document.getElementById('stage').getBoundingClientRect(); return [r.left, r.top, r.width / 160];";
    let at: Vec<f64> = browser.script(scale).as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    let points: Vec<[f64; 2]> = points.iter().map(|p| [at[0] + p[0] * at[2], at[1] + p[1] * at[2]]).collect();
    browser.drag(&points);
}

fn clip(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    for t in 0..3u8 {
        RgbImage::from_pixel(160, 120, Rgb([60 + 40 * t, 90, 60])).save(folder.join(format!("{t}.png"))).unwrap();
    }
}

fn on(path: &Path, x: u32, y: u32) -> bool {
    image::open(path).unwrap().into_luma8().get_pixel(x, y).0[0] == 255
}

#[test]
fn drawings_are_saved_copied_undone_and_kept() {
    let dir = tempfile::tempdir().unwrap();
    clip(&dir.path().join("clip"));
    let out = dir.path().join("drawn");
    let (_page, line) = started(
        Command::new(env!("CARGO_BIN_EXE_muybridge")).args(["animal", "sketch"]).arg(dir.path().join("clip")).arg("-o").arg(&out),
        "http://127.0.0.1:",
    );
    let address = line.split_whitespace().find(|w| w.starts_with("http://")).unwrap().to_string();
    let port: u16 = address.trim_end_matches('/').rsplit(':').next().unwrap().parse().unwrap();

    // Other pages of a browser cannot write: their requests name another host, or are no drawings.
    let own = format!("127.0.0.1:{port}");
    assert_eq!(http(port, "GET", "/clip.json", "evil.example", "").0, 403);
    assert_eq!(http(port, "POST", "/strokes/0", &own, "{\"strokes\":7}").0, 400);
    assert_eq!(http(port, "GET", "/frame/3", &own, "").0, 404);
    assert_eq!(http(port, "GET", "/../../etc/passwd", &own, "").0, 404);

    let browser = Browser::open(dir.path(), &[]);
    browser.call("POST", "/url", json!({ "url": address }));
    browser.wait("document.getElementById('stage').dataset.frame === '0'");

    // A spine and a leg.
    draw(&browser, &[[30.0, 40.0], [70.0, 38.0], [110.0, 42.0]]);
    browser.wait("document.getElementById('state').textContent === 'frame 0 saved'");
    browser.click("[data-tool=leg]");
    draw(&browser, &[[40.0, 50.0], [45.0, 100.0]]);
    browser.wait("drawing.strokes.length === 2");
    let first = out.join("000000.png");
    let saved = |n: usize| browser.wait(&format!("drawing.strokes.length === {n}"));
    saved(2);
    browser.script("return saving;");
    assert!(on(&first, 70, 38) && on(&first, 42, 75) && !on(&first, 70, 80));
    let facts: Value = serde_json::from_str(&std::fs::read_to_string(out.join("000000.json")).unwrap()).unwrap();
    assert_eq!((facts["strokes"][0]["part"].as_str(), facts["strokes"][1]["part"].as_str()), (Some("spine"), Some("leg")));

    // The next frame shows it through and copies it; undo takes one back.
    browser.click("#next");
    browser.wait("document.getElementById('stage').dataset.frame === '1'");
    let tint = |x: u32, y: u32| {
        browser.script(&format!("return Array.from(document.getElementById('stage').getContext('2d').getImageData({x}, {y}, 1, 1).data);"))
    };
    assert!(tint(70, 38) != tint(70, 80), "onion skin");
    browser.click("#onion");
    assert_eq!(tint(70, 38), tint(70, 80));
    assert!(!out.join("000001.png").exists());
    browser.click("#copy");
    saved(2);
    browser.wait("document.getElementById('state').textContent === 'frame 1 saved'");
    browser.click("#undo");
    saved(1);
    browser.script("return saving;");
    let second = out.join("000001.png");
    assert!(on(&second, 70, 38) && !on(&second, 42, 75));

    // Boxes become options of `animal masks`.
    browser.click("[data-tool=subject]");
    draw(&browser, &[[50.0, 30.0], [90.0, 60.0]]);
    browser.wait("drawing.rectangles.length === 1");
    browser.script("return saving;");
    let options = std::fs::read_to_string(out.join("rectangles.txt")).unwrap();
    let numbers: Vec<i64> = options.trim().strip_prefix("--subject 1:").unwrap().split(',').map(|n| n.parse().unwrap()).collect();
    assert!(numbers.iter().zip([50, 30, 40, 30]).all(|(a, b)| (a - b).abs() <= 1), "{options}");

    // All of it is there again after the page is loaded anew.
    browser.call("POST", "/refresh", json!({}));
    browser.wait("document.getElementById('stage').dataset.frame === '0' && drawing.strokes.length === 2");
    browser.click("#clear");
    saved(0);
    browser.script("return saving;");
    assert!(!first.exists() && second.exists());
    browser.call("DELETE", "", json!({}));
}
