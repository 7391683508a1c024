//! A headless Chromium, driven through WebDriver; `.ci/install` installs it and its driver.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use serde_json::{Value, json};

/// A process of this test's own, ended with it.
pub struct Own(Child);

impl Drop for Own {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Starts a program and waits for the first line of its output that holds `mark`.
pub fn started(command: &mut Command, mark: &str) -> (Own, String) {
    let mut child =
        command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().expect("the program starts; .ci/install installs browsers");
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let line = lines.by_ref().map(Result::unwrap).find(|l| l.contains(mark)).expect("the program says that it is ready");
    // What follows must not fill the pipe.
    std::thread::spawn(move || lines.count());
    (Own(child), line)
}

/// Status and body of one HTTP request to this machine.
pub fn http(port: u16, method: &str, path: &str, host: &str, body: &str) -> (u16, String) {
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
pub struct Browser {
    port: u16,
    session: String,
    _driver: Own,
}

impl Browser {
    /// A headless Chromium with its profile in `folder`; `arguments` besides the usual ones.
    pub fn open(folder: &Path, arguments: &[&str]) -> Browser {
        let (driver, line) = started(Command::new("chromedriver").arg("--port=0"), "was started successfully on port");
        let port: u16 = line.rsplit_once("port ").unwrap().1.trim_end_matches('.').trim().parse().unwrap();
        let profile = format!("--user-data-dir={}", folder.join("profile").display());
        let usual = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--window-size=1200,900",
            &profile,
        ];
        let arguments: Vec<&str> = usual.iter().chain(arguments).copied().collect();
        let options = json!({ "goog:chromeOptions": { "args": arguments }, "goog:loggingPrefs": { "browser": "ALL" } });
        let wanted = json!({ "capabilities": { "alwaysMatch": options } });
        let (status, text) = http(port, "POST", "/session", &format!("127.0.0.1:{port}"), &wanted.to_string());
        assert_eq!(status, 200, "{text}");
        let session = serde_json::from_str::<Value>(&text).unwrap()["value"]["sessionId"].as_str().unwrap().to_string();
        Browser { port, session, _driver: driver }
    }

    pub fn call(&self, method: &str, path: &str, body: Value) -> Value {
        let body = if method == "GET" { String::new() } else { body.to_string() };
        let (status, text) =
            http(self.port, method, &format!("/session/{}{path}", self.session), &format!("127.0.0.1:{}", self.port), &body);
        let value: Value = serde_json::from_str(&text).unwrap();
        assert_eq!(status, 200, "{path}: {text}");
        value["value"].clone()
    }

    pub fn script(&self, script: &str) -> Value {
        self.call("POST", "/execute/sync", json!({ "script": script, "args": [] }))
    }

    /// Waits until a script gives true.
    pub fn wait(&self, script: &str) {
        for _ in 0..300 {
            if self.script(&format!("return ({script});")) == json!(true) {
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("never true: {script}; the page says {}", self.script("return document.body.innerText.slice(0, 2000);"));
    }

    pub fn click(&self, selector: &str) {
        let found = self.call("POST", "/element", json!({ "using": "css selector", "value": selector }));
        let element = found.as_object().unwrap().values().next().unwrap().as_str().unwrap().to_string();
        self.call("POST", &format!("/element/{element}/click"), json!({}));
    }

    /// Draws with the mouse along points of the window.
    pub fn drag(&self, points: &[[f64; 2]]) {
        let place = |p: &[f64; 2]| json!({ "type": "pointerMove", "duration": 0, "x": p[0].round(), "y": p[1].round() });
        let mut actions = vec![place(&points[0]), json!({ "type": "pointerDown", "button": 0 })];
        actions.extend(points[1..].iter().map(place));
        actions.push(json!({ "type": "pointerUp", "button": 0 }));
        let mouse = json!({ "type": "pointer", "id": "mouse", "parameters": { "pointerType": "mouse" }, "actions": actions });
        self.call("POST", "/actions", json!({ "actions": [mouse] }));
    }
}
