#!/usr/bin/env python3
"""Whether a recording of `track --rrd` holds every frame, by rerun's own reader.

    pip install rerun-sdk==0.28.2
    python3 benches/rrd.py walk.rrd walk/fit.json

Prints what every entity holds; fails where one lacks a frame of fit.json, or its time or a camera is not there.
"""
import json, sys, warnings

warnings.simplefilter("ignore")
from rerun.dataframe import load_recording

recording = load_recording(sys.argv[1])
frames = json.load(open(sys.argv[2]))["frames"]
components = recording.schema().component_columns()
cameras = sorted({c.entity_path for c in components if c.is_static and c.component.startswith("Pinhole")})
wanted = {f"{camera}/picture": "EncodedImage:blob" for camera in cameras}
wanted |= {"/world/cloud": "Points3D:positions", "/world/body": "Ellipsoids3D:half_sizes", "/world/skeleton": "LineStrips3D:strips"}
wanted |= {f"/curves/{name}": "Scalars:scalars" for name in ("phase", "root/x", "root/y", "root/z", "points")}
print("static:", ", ".join(sorted({f"{c.entity_path} {c.component}" for c in components if c.is_static})))
lacking = []
for index, key in (("frame", "frame"), ("time", "time_s")):
    table = recording.view(index=index, contents="/**").select().read_all()
    times = [t.total_seconds() if hasattr(t, "total_seconds") else t for t in table.column(index).to_pylist()]
    if len(times) != len(frames) or any(abs(a - b[key]) > 1e-6 for a, b in zip(times, frames)):
        lacking.append(f"timeline {index}: {times[:3]}...")
    for entity, component in wanted.items():
        values = table.column(f"{entity}:{component}").to_pylist()
        held = sum(v is not None for v in values)
        print(f"{index}: {entity} {component}: {held} of {len(frames)} frames, {sum(len(v) for v in values if v is not None)} items")
        if held != len(frames):
            lacking.append(f"{entity} on {index}")
if not cameras or lacking:
    sys.exit(f"lacking: {lacking or 'cameras'}")
