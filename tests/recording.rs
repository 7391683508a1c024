//! What `track --rrd` writes, read by rerun's own decoder.
#![cfg(feature = "rerun")]

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use assert_cmd::Command;
use muybridge::body::{Joint, Shape};
use muybridge::io::{bvh, calib_toml, joints_csv};
use muybridge::motion::{Length, play_cycle};
use muybridge::motion_model::{Activity, synthetic};
use nalgebra::Vector3;
use re_chunk::Chunk;
use re_log_encoding::DecoderApp;
use re_log_types::LogMsg;
use re_types::archetypes::{EncodedImage, LineStrips3D, RecordingInfo, Scalars};
use re_types::components::{Blob, LineStrip3D, Name, Scalar};

const FRAMES: usize = 6;

fn run(arguments: &[&str]) {
    let output = Command::cargo_bin("muybridge").unwrap().args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Chunks of every entity.
fn chunks(bytes: &[u8]) -> BTreeMap<String, Vec<Chunk>> {
    let mut found: BTreeMap<String, Vec<Chunk>> = BTreeMap::new();
    for message in DecoderApp::decode_lazy(bytes) {
        if let LogMsg::ArrowMsg(_, message) = message.unwrap() {
            let chunk = Chunk::from_arrow_msg(&message).unwrap();
            found.entry(chunk.entity_path().to_string()).or_default().push(chunk);
        }
    }
    found
}

#[test]
fn a_track_is_recorded_whole_and_the_same_every_time() {
    let place = tempfile::tempdir().unwrap();
    let at = |name: &str| place.path().join(name).to_str().unwrap().to_string();
    let subject = synthetic::subject(Activity::Walking, 7);
    let clip = play_cycle(&subject.cycle(1.3, 0), &Shape::template(1.7).offsets(), 12.0, Length::Seconds((FRAMES - 1) as f64 / 12.0));
    bvh::write_clip(Path::new(&at("walk.bvh")), &clip, None).unwrap();
    let rig = Path::new(env!("CARGO_MANIFEST_DIR")).join("calib/phantom_lab.toml");
    run(&["render", &at("walk.bvh"), "--rig", rig.to_str().unwrap(), "--fps", "12", "-o", &at("session")]);
    let bytes = ["1", "2"].map(|threads| {
        let (output, file) = (at(&format!("out{threads}")), at(&format!("recordings/{threads}.rrd")));
        run(&[
            "--threads",
            threads,
            "track",
            &at("session"),
            "--fps",
            "12",
            "--activity",
            "walking",
            "--no-report",
            "-o",
            &output,
            "--rrd",
            &file,
        ]);
        fs::read(file).unwrap()
    });
    assert_eq!(fs::read_dir(at("recordings")).unwrap().count(), 2);
    assert!(bytes[0].starts_with(b"RRF2") && bytes[0] == bytes[1], "the same bytes with one thread and two");

    let found = chunks(&bytes[0]);
    let rig = calib_toml::read_rig(&rig).unwrap();
    let mut expected: Vec<String> =
        ["phase", "root_x_m", "root_y_m", "root_z_m", "speed_m_s", "rms_mm"].map(|name| format!("/curves/{name}")).into();
    expected.extend(["", "/cloud", "/body", "/skeleton"].map(|name| format!("/world{name}")));
    expected.extend(rig.cameras.iter().flat_map(|c| ["", "/picture"].map(|part| format!("/world/cameras/{}{part}", c.name))));
    expected.push("/__properties".into());
    expected.sort();
    assert_eq!(found.keys().cloned().collect::<Vec<_>>(), expected);
    for (entity, chunks) in &found {
        let moving: Vec<&Chunk> = chunks.iter().filter(|chunk| !chunk.is_static()).collect();
        for chunk in &moving {
            let mut timelines: Vec<&str> = chunk.timelines().keys().map(|name| name.as_str()).collect();
            timelines.sort_unstable();
            assert_eq!(timelines, ["frame", "time"], "{entity}");
        }
        let rows: usize = moving.iter().map(|chunk| chunk.num_rows()).sum();
        let still =
            ["/world", "/__properties"].contains(&entity.as_str()) || entity.starts_with("/world/cameras") && !entity.ends_with("/picture");
        assert_eq!(rows, if still { 0 } else { FRAMES }, "{entity}");
    }

    let mut names = found["/__properties"][0].iter_component::<Name>(RecordingInfo::descriptor_name().component);
    assert_eq!(names.next().unwrap().as_slice()[0].as_str(), "session");

    // Bones end where joints.csv has them.
    let joints = joints_csv::read(Path::new(&at("out1/joints.csv"))).unwrap();
    let bones = &found["/world/skeleton"][0];
    let children: Vec<Joint> = Joint::ALL.into_iter().filter(|joint| joint.parent().is_some()).collect();
    let strips = bones.iter_component::<LineStrip3D>(LineStrips3D::descriptor_strips().component);
    for (strips, positions) in strips.zip(joints.values()) {
        assert_eq!(strips.as_slice().len(), children.len());
        for (strip, joint) in strips.as_slice().iter().zip(&children) {
            let end = Vector3::from(strip.0[1].0.map(f64::from));
            assert!((end - positions[*joint as usize]).norm() < 1e-4, "{}", joint.name());
        }
    }
    let speeds = found["/curves/speed_m_s"][0].iter_component::<Scalar>(Scalars::descriptor_scalars().component);
    let speeds: Vec<f64> = speeds.map(|s| s.as_slice()[0].0.0).collect();
    assert!(speeds.iter().all(|v| (v - 1.3).abs() < 0.2), "{speeds:?}");
    for picture in &found[&format!("/world/cameras/{}/picture", rig.cameras[0].name)] {
        let blob = picture.iter_component::<Blob>(EncodedImage::descriptor_blob().component).next().unwrap();
        let picture = image::load_from_memory(blob.as_slice()[0].as_ref()).unwrap();
        assert_eq!([picture.width(), picture.height()], rig.cameras[0].size_px);
    }
}
