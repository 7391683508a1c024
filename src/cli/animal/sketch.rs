//! `muybridge animal sketch`: a local page to draw on the frames.
//!
//! GET / is the page, /clip.json its facts, /frame/N the frame as PNG, /strokes/N what is drawn on it; POST /strokes/N
//! saves at once: `DIR/N.json` with strokes and rectangles, `DIR/N.png` with the strokes as binary image. Only requests
//! from this machine that name it as host are answered, so that no other page of a browser can write.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, Result, anyhow};
use image::{ImageFormat, RgbImage};
use muybridge::animal::masks::Rectangle;
use muybridge::animal::render::{Stroke, strokes};
use muybridge::io::animal_clip::{read_clip, write_mask};
use muybridge::io::write_atomic;
use serde::{Deserialize, Serialize};
use tiny_http::{Header, Method, Request, Response, Server};

use super::super::interrupt;

const PAGE: &str = include_str!("sketch.html");
/// A drawing of this size, bytes, is no drawing.
const LARGEST: u64 = 4 << 20;

#[derive(clap::Args)]
pub struct SketchArgs {
    /// A video, or a folder of PNG or JPEG pictures
    video: PathBuf,
    /// Folder for the drawings: one PNG and one JSON per drawn frame
    #[arg(short, long)]
    output: PathBuf,
    /// Port on 127.0.0.1; 0 takes a free one
    #[arg(long, default_value_t = 0)]
    port: u16,
}

/// What is drawn on a frame, pixels of the video.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Drawing {
    strokes: Vec<Stroke>,
    rectangles: Vec<Drawn>,
}

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Drawn {
    subject: bool,
    #[serde(flatten)]
    rectangle: Rectangle,
}

struct Desk {
    frames: Vec<RgbImage>,
    folder: PathBuf,
    port: u16,
}

pub fn run(args: &SketchArgs) -> Result<()> {
    let clip = read_clip(&args.video, None)?;
    clip.notices.iter().for_each(|n| eprintln!("notice: {n}"));
    let server = Server::http(("127.0.0.1", args.port))
        .map_err(|e| anyhow!("cannot listen on 127.0.0.1:{}: {e}; choose another --port", args.port))?;
    let port = server.server_addr().to_ip().map_or(args.port, |a| a.port());
    std::fs::create_dir_all(&args.output).with_context(|| format!("cannot create {}", args.output.display()))?;
    let desk = Desk { frames: clip.frames, folder: args.output.clone(), port };
    println!("draw at http://127.0.0.1:{port}/ ; every change is saved in {}; Ctrl-C ends", args.output.display());
    while !interrupt::came() {
        if let Some(request) = server.recv_timeout(Duration::from_millis(200))? {
            desk.answer(request);
        }
    }
    Ok(())
}

struct Reply {
    status: u16,
    kind: &'static str,
    body: Vec<u8>,
}

impl Reply {
    fn ok(kind: &'static str, body: Vec<u8>) -> Reply {
        Reply { status: 200, kind, body }
    }

    fn wrong(status: u16, text: &str) -> Reply {
        Reply { status, kind: "text/plain; charset=utf-8", body: text.as_bytes().to_vec() }
    }
}

impl Desk {
    fn answer(&self, mut request: Request) {
        let host = request.headers().iter().find(|h| h.field.equiv("Host")).map(|h| h.value.to_string());
        let own = [format!("127.0.0.1:{}", self.port), format!("localhost:{}", self.port)];
        let reply = if host.is_some_and(|h| own.contains(&h)) {
            let mut body = String::new();
            let read = request.as_reader().take(LARGEST + 1).read_to_string(&mut body);
            match read {
                Ok(n) if (n as u64) <= LARGEST => self.reply(request.method(), request.url(), &body),
                _ => Reply::wrong(400, "the request cannot be read, or is too large"),
            }
        } else {
            Reply::wrong(403, "only pages of this program are answered")
        };
        let mut response = Response::from_data(reply.body).with_status_code(reply.status);
        if let Ok(header) = Header::from_bytes("Content-Type", reply.kind) {
            response.add_header(header);
        }
        // The browser may have gone.
        let _ = request.respond(response);
    }

    fn reply(&self, method: &Method, url: &str, body: &str) -> Reply {
        let parts: Vec<&str> = url.trim_matches('/').split('/').collect();
        let frame = |text: &str| text.parse::<usize>().ok().filter(|n| *n < self.frames.len());
        match (method, parts.as_slice()) {
            (Method::Get, [""]) => Reply::ok("text/html; charset=utf-8", PAGE.into()),
            (Method::Get, ["clip.json"]) => {
                let (width, height) = self.frames.first().map_or((0, 0), |f| f.dimensions());
                let drawn: Vec<usize> = (0..self.frames.len()).filter(|n| self.path(*n, "json").exists()).collect();
                let facts = serde_json::json!({ "frames": self.frames.len(), "width": width, "height": height, "drawn": drawn });
                Reply::ok("application/json", facts.to_string().into())
            }
            (Method::Get, ["frame", n]) => match frame(n).and_then(|n| png(&self.frames[n])) {
                Some(bytes) => Reply::ok("image/png", bytes),
                None => Reply::wrong(404, "no such frame"),
            },
            (Method::Get, ["strokes", n]) => match frame(n) {
                Some(n) => Reply::ok(
                    "application/json",
                    std::fs::read(self.path(n, "json")).unwrap_or_else(|_| b"{\"strokes\":[],\"rectangles\":[]}".to_vec()),
                ),
                None => Reply::wrong(404, "no such frame"),
            },
            (Method::Post, ["strokes", n]) => match (frame(n), serde_json::from_str::<Drawing>(body)) {
                (Some(n), Ok(drawing)) => match self.save(n, &drawing) {
                    Ok(()) => Reply::ok("application/json", b"{}".to_vec()),
                    Err(e) => Reply::wrong(500, &format!("{e:#}")),
                },
                (None, _) => Reply::wrong(404, "no such frame"),
                (_, Err(e)) => Reply::wrong(400, &e.to_string()),
            },
            _ => Reply::wrong(404, "nothing here"),
        }
    }

    fn path(&self, frame: usize, extension: &str) -> PathBuf {
        self.folder.join(format!("{frame:06}.{extension}"))
    }

    fn save(&self, frame: usize, drawing: &Drawing) -> Result<()> {
        let sound =
            drawing.strokes.iter().all(|s| (0.0..=1000.0).contains(&s.width_px) && s.points.iter().flatten().all(|v| v.is_finite()));
        anyhow::ensure!(sound, "strokes must have finite points and widths from 0 to 1000 px");
        let picture = strokes(&drawing.strokes, self.frames[frame].dimensions().into());
        let failed = |path: &Path| format!("cannot write {}", path.display());
        if drawing.strokes.is_empty() {
            // A frame without strokes is no binary image.
            let path = self.path(frame, "png");
            if path.exists() {
                std::fs::remove_file(&path).with_context(|| failed(&path))?;
            }
        } else {
            write_mask(&self.path(frame, "png"), &picture)?;
        }
        let path = self.path(frame, "json");
        write_atomic(&path, serde_json::to_string(drawing)?.as_bytes()).with_context(|| failed(&path))?;
        self.write_rectangles()
    }

    /// All rectangles as options of `animal masks`.
    fn write_rectangles(&self) -> Result<()> {
        let mut options = String::new();
        for frame in 0..self.frames.len() {
            let Ok(text) = std::fs::read_to_string(self.path(frame, "json")) else { continue };
            let drawing: Drawing = serde_json::from_str(&text).unwrap_or_default();
            for Drawn { subject, rectangle: Rectangle { x, y, width, height } } in drawing.rectangles {
                options += &format!("--{} {frame}:{x},{y},{width},{height}\n", if subject { "subject" } else { "background" });
            }
        }
        let path = self.folder.join("rectangles.txt");
        write_atomic(&path, options.as_bytes()).with_context(|| format!("cannot write {}", path.display()))
    }
}

fn png(picture: &RgbImage) -> Option<Vec<u8>> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, ImageFormat::Png).ok()?;
    Some(bytes.into_inner())
}
