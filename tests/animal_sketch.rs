//! The sketch page in a headless Chromium, driven through WebDriver: strokes, onion skin, copy, undo, boxes, saving; and who
//! is not answered. `.ci/install` installs Chromium and its driver.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use image::{Rgb, RgbImage};
use serde_json::{Value, json};

/// A process of this test's own, ended with it.
struct Own(Child);

impl Drop for Own {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a program and waits for the first line of its output that holds `mark`.
fn started(command: &mut Command, mark: &str) -> (Own, String) {
    let mut child =
        command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("the program starts; .ci/install installs browsers");
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let line = lines.by_ref().map(Result::unwrap).find(|l| l.contains(mark)).expect("the program says that it is ready");
    // What follows must not fill the pipe.
    std::thread::spawn(move || lines.count());
    (Own(child), line)
}

/// Status and body of one HTTP request to this machine.
fn http(port: u16, method: &str, path: &str, host: &str, body: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
    write!(stream, "{method} {path} HTTP/1.1\r\nHost: {host}\r\nContent-Type: application/json\r\nContent-Length: {}\r\nConnection: close\r\n\r\n{body}", body.len()).unwrap();
    let mut reader = BufReader::new(stream);
    let mut line = String::new();
    reader.read_line(&mut line).unwrap();
    let status = line.split_whitespace().nth(1).unwrap().parse().unwrap();
    let (mut length, mut chunked) = (None, false);
    loop {
        line.clear();
        reader.read_line(&mut line).unwrap();
        let header = line.trim().to_ascii_lowercase();
        if header.is_empty() {
            break;
        }
        length = header.strip_prefix("content-length:").map(|n| n.trim().parse::<usize>().unwrap()).or(length);
        chunked |= header.starts_with("transfer-encoding:") && header.contains("chunked");
    }
    let mut bytes = Vec::new();
    match length {
        Some(n) => {
            bytes.resize(n, 0);
            reader.read_exact(&mut bytes).unwrap();
        }
        None => {
            reader.read_to_end(&mut bytes).unwrap();
        }
    }
    let text = String::from_utf8_lossy(&bytes).into_owned();
    (status, if chunked { text.split("\r\n").skip(1).step_by(2).collect() } else { text })
}

/// A browser's session.
struct Browser {
    port: u16,
    session: String,
}

impl Browser {
    fn call(&self, method: &str, path: &str, body: Value) -> Value {
        let body = if method == "GET" { String::new() } else { body.to_string() };
        let (status, text) =
            http(self.port, method, &format!("/session/{}{path}", self.session), &format!("127.0.0.1:{}", self.port), &body);
        let value: Value = serde_json::from_str(&text).unwrap();
        assert_eq!(status, 200, "{path}: {text}");
        value["value"].clone()
    }

    fn script(&self, script: &str) -> Value {
        self.call("POST", "/execute/sync", json!({ "script": script, "args": [] }))
    }

    /// Waits until a script gives true.
    fn wait(&self, script: &str) {
        for _ in 0..300 {
            if self.script(&format!("return ({script});")) == json!(true) {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("never true: {script}; the page says {}", self.script("return document.getElementById('state').textContent;"));
    }

    fn click(&self, selector: &str) {
        let found = self.call("POST", "/element", json!({ "using": "css selector", "value": selector }));
        let element = found.as_object().unwrap().values().next().unwrap().as_str().unwrap().to_string();
        self.call("POST", &format!("/element/{element}/click"), json!({}));
    }

    /// Draws with the mouse along points of the video's pixels.
    fn drag(&self, points: &[[f64; 2]]) {
        let scale = "const r = document.getElementById('stage').getBoundingClientRect(); return [r.left, r.top, r.width / 160];";
        let at: Vec<f64> = self.script(scale).as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
        let place = |p: &[f64; 2]| json!({ "type": "pointerMove", "duration": 0, "x": (at[0] + p[0] * at[2]).round(), "y": (at[1] + p[1] * at[2]).round() });
        let mut actions = vec![place(&points[0]), json!({ "type": "pointerDown", "button": 0 })];
        actions.extend(points[1..].iter().map(place));
        actions.push(json!({ "type": "pointerUp", "button": 0 }));
        let mouse = json!({ "type": "pointer", "id": "mouse", "parameters": { "pointerType": "mouse" }, "actions": actions });
        self.call("POST", "/actions", json!({ "actions": [mouse] }));
    }
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

    let (_driver, line) = started(Command::new("chromedriver").arg("--port=0"), "was started successfully on port");
    let driver: u16 = line.rsplit_once("port ").unwrap().1.trim_end_matches('.').trim().parse().unwrap();
    let profile = dir.path().join("profile");
    let arguments = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--window-size=1200,900",
        &format!("--user-data-dir={}", profile.display()),
    ];
    let wanted = json!({ "capabilities": { "alwaysMatch": { "goog:chromeOptions": { "args": arguments } } } });
    let (status, text) = http(driver, "POST", "/session", &format!("127.0.0.1:{driver}"), &wanted.to_string());
    assert_eq!(status, 200, "{text}");
    let session = serde_json::from_str::<Value>(&text).unwrap()["value"]["sessionId"].as_str().unwrap().to_string();
    let browser = Browser { port: driver, session };
    browser.call("POST", "/url", json!({ "url": address }));
    browser.wait("document.getElementById('stage').dataset.frame === '0'");

    // A spine and a leg.
    browser.drag(&[[30.0, 40.0], [70.0, 38.0], [110.0, 42.0]]);
    browser.wait("document.getElementById('state').textContent === 'frame 0 saved'");
    browser.click("[data-tool=leg]");
    browser.drag(&[[40.0, 50.0], [45.0, 100.0]]);
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
    browser.drag(&[[50.0, 30.0], [90.0, 60.0]]);
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
