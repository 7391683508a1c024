#!/usr/bin/env python3
"""Writes the seeds of the fuzz targets to fixtures/fuzz/TARGET: tiny files of every form, good-*, and ones that lie, bad-*.

Standard library only. What the fuzzer found lies beside them under its own names and stays."""

import io
import json
import pathlib
import re
import struct
import zipfile

ROOT = pathlib.Path(__file__).resolve().parent.parent
OUT = ROOT / "fixtures/fuzz"


def seed(target, name, content, kind="good"):
    path = OUT / target / f"{kind}-{name}"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def calib():
    camera = "size = [64, 48]\nmatrix = [[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]\ndistortions = [0.1, 0, 0, 0]\nrotation = [0, 0, 0]\n"
    plain = f'[cam_00]\nname = "a"\n{camera}translation = [0, 0, 0]\n[cam_01]\n{camera}fisheye = true\ntranslation = [-0.3, 0, 0]\n'
    seed("calib_toml", "plain", plain + '[metadata]\nup = "y"\n')
    matrix = "rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]"
    for name, table in [("way_out", '"../../etc"'), ("absolute", '"/tmp/x"'), ("hidden", '".."'), ("line", '"a\\nb"')]:
        seed("calib_toml", name, plain.replace("cam_00", table).replace('name = "a"\n', ""), "bad")
    seed("calib_toml", "same_name", plain.replace("cam_00", "cameras.7").replace("cam_01", "cam_7"), "bad")
    seed("calib_toml", "caliscope", "[cameras.0]\nignore = false\n" + camera.replace("rotation = [0, 0, 0]", matrix) + "translation = [0, 0, 0]\n")


def rigs():
    def m(key, rows, cols, data):
        return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n"

    k, eye = "600., 0., 320., 0., 600., 240., 0., 0., 1.", "1., 0., 0., 0., 1., 0., 0., 0., 1."
    one = lambda c, x: m(f"K_{c}", 3, 3, k) + m(f"dist_{c}", 1, 5, "0., 0., 0., 0., 0.") + m(f"R_{c}", 3, 1, "0., 0., 0.") + m(f"T_{c}", 3, 1, x)
    seed("rig_files", "easymocap", '%YAML:1.0\n---\nnames:\n  - "0"\n  - "1"\n' + one("0", "0., 0., 0.") + one("1", "-0.3, 0., 0."))
    stereo = m("M1", 3, 3, k) + m("D1", 1, 4, "0., 0., 0., 0.") + m("M2", 3, 3, k) + m("D2", 1, 4, "0., 0., 0., 0.")
    seed("rig_files", "stereo", "%YAML:1.0\n---\n" + stereo + m("R", 3, 3, eye) + m("T", 3, 1, "-0.3, 0., 0."))
    xml = lambda key, rows, cols, data: (
        f'<{key} type_id="opencv-matrix"><rows>{rows}</rows><cols>{cols}</cols><dt>d</dt><data>{data.replace(",", "")}</data></{key}>\n'
    )
    body = "".join(xml(n, 3, 3, k) for n in ("M1", "M2")) + "".join(xml(n, 1, 4, "0. 0. 0. 0.") for n in ("D1", "D2"))
    seed("rig_files", "xml", f'<?xml version="1.0"?>\n<opencv_storage>\n{body}{xml("R", 3, 3, eye)}{xml("T", 3, 1, "-0.3 0. 0.")}</opencv_storage>\n')
    array = lambda rows, cols, data: {"type_id": "opencv-matrix", "rows": rows, "cols": cols, "dt": "d", "data": data}
    ks, ds = [600.0, 0.0, 320.0, 0.0, 600.0, 240.0, 0.0, 0.0, 1.0], [0.0] * 4
    keys = {"M1": array(3, 3, ks), "M2": array(3, 3, ks), "D1": array(1, 4, ds), "D2": array(1, 4, ds)}
    keys |= {"R": array(3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), "T": array(3, 1, [-0.3, 0.0, 0.0])}
    seed("rig_files", "json", json.dumps(keys, indent=1))
    lens = "  camera_model: pinhole\n  intrinsics: [600, 600, 320, 240]\n  distortion_model: radtan\n  distortion_coeffs: [0, 0, 0, 0]\n  resolution: [640, 480]\n"
    move = "  T_cn_cnm1:\n  - [1, 0, 0, -0.3]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n"
    deep = lambda start, left, right: start + left * 2000 + "1" + right * 2000 + "\n"
    seed("rig_files", "deep_json", deep("", '{"a":', "}"), "bad")
    seed("rig_files", "deep_yaml", deep("%YAML:1.0\n---\na: ", "[", "]"), "bad")
    seed("rig_files", "deep_xml", deep('<?xml version="1.0"?>\n<opencv_storage>', "<a>", "</a>") + "</opencv_storage>", "bad")
    seed("rig_files", "deep_kalibr", deep("cam0:\n  intrinsics: ", "[", "]"), "bad")
    seed("rig_files", "kalibr", f"cam0:\n{lens}cam1:\n{lens}{move}")


def mocap():
    folder = ROOT / "fixtures/mocap"
    motion = (folder / "tiny.bvh").read_text().splitlines()
    at = next(i for i, line in enumerate(motion) if line.startswith("Frames:"))
    seed("bvh", "person", "\n".join(motion[:at] + ["Frames: 2"] + motion[at + 1 : at + 4]) + "\n")
    joints = "".join(f"JOINT j{i}\n{{\nOFFSET 0 0 0\n}}\n" for i in range(200))
    still = f"HIERARCHY\nROOT a\n{{\nOFFSET 0 0 0\nCHANNELS 1 Xposition\n{joints}}}\nMOTION\nFrames: 2\nFrame Time: 1\n0\n0\n"
    seed("bvh", "still_joints", still, "bad")
    asf, amc = (folder / "tiny.asf").read_text(), (folder / "tiny_01.amc").read_text()
    seed("asf_amc", "person", asf + "\n===\n" + amc)
    seed("mot", "angles", (folder / "tiny.mot").read_bytes())
    head = "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    head += "100\t100\t3\t2\tmm\t100\t1\t3\nFrame#\tTime\tRASI\t\t\tLASI\t\t\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n\n"
    seed("trc", "table", head + "1\t0.00\t1\t2\t3\t4\t5\t6\n2\t0.01\t1\t2\t3\t\t\t\n3\t0.02\tNaN\t2\t3\t4\t5\t6\n")


def c3d(floats, processor):
    order = ">" if processor == 86 else "<"
    number = lambda v: struct.pack("<f", 4 * v)[2:] + struct.pack("<f", 4 * v)[:2] if processor == 85 else struct.pack(order + "f", v)
    scale = number(-1.0 if floats else 0.1)
    header = struct.pack("BB", 2, 0x50) + struct.pack(order + "5H", 2, 0, 1, 3, 10) + scale + struct.pack(order + "2H", 3, 0) + number(100.0)
    group = lambda i, name: struct.pack("bb", len(name), -i) + name + struct.pack(order + "hB", 3, 0)

    def parameter(i, name, kind, dimensions, data):
        body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
        return struct.pack("bb", len(name), i) + name + struct.pack(order + "h", 2 + len(body)) + body

    word = lambda v: struct.pack(order + "H", v)
    body = group(1, b"POINT") + parameter(1, b"USED", 2, [], word(2)) + parameter(1, b"FRAMES", 2, [], word(3))
    body += parameter(1, b"DATA_START", 2, [], word(3)) + parameter(1, b"SCALE", 4, [], scale) + parameter(1, b"RATE", 4, [], number(100.0))
    body += parameter(1, b"LABELS", -1, [4, 2], b"RASILASI") + parameter(1, b"UNITS", -1, [2], b"mm")
    section = struct.pack("BBBB", 1, 0x50, 1, processor) + body + b"\0\0"
    value = (lambda v: number(float(v))) if floats else (lambda v: struct.pack(order + "h", v))
    data = b"".join(value(10 * f + p + a) if a < 3 else value(0) for f in range(3) for p in range(2) for a in range(4))
    return header.ljust(512, b"\0") + section.ljust(512, b"\0") + data


def c3d_lies():
    """Counts as floats, beyond all that words hold."""
    whole = c3d(True, 84)
    used = whole.index(b"USED") + 4
    for name, value in [("used", 1e30), ("used_negative", -5.0), ("used_nan", float("nan"))]:
        lie = bytearray(whole)
        lie[used : used + 8] = struct.pack("<hbBf", 8, 4, 0, value)
        seed("c3d", name, bytes(lie).replace(b"\x06FRAMES", b"\x06XRAMES"), "any")
    seed("c3d", "a_million_frames", whole[:6] + b"\0\0\xff\xff" + whole[10:1040], "any")


def maps():
    names = "x y z".split(), "red green blue".split(), "confidence cxx cxy cxz cyy cyz czz".split()
    rows = [(t, n) for t, group in zip(("float", "uchar", "float"), names) for n in group]
    head = lambda form: f"ply\nformat {form} 1.0\nelement vertex 2\n" + "".join(f"property {t} {n}\n" for t, n in rows) + "end_header\n"
    point = struct.pack("<3f3B7f", 1, 2, 3, 4, 5, 6, 0.5, 1, 0, 0, 1, 0, 1)
    seed("ply", "binary", head("binary_little_endian").encode() + point * 2)
    seed("ply", "ascii", head("ascii") + "1 2 3 4 5 6 0.5 1 0 0 1 0 1\n" * 2)
    seed("ply", "promises", (head("ascii") + "1 2 3 4 5 6 0.5 1 0 0 1 0 1\n").replace("vertex 2", "vertex 4000000000"), "bad")
    long = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uint float x\nend_header\n"
    seed("ply", "long_list", long.encode() + b"\xff\xff\xff\xff1234", "bad")
    seed("pfm", "promises", b"Pf\n65535 65535\n-1.0\n1234", "bad")
    seed("pfm", "little", b"Pf\n2 2\n-1.0\n" + struct.pack("<4f", 1, 2, 3, float("inf")))
    seed("pfm", "big", b"Pf\n2 1\n1.0\n" + struct.pack(">2f", 1, 2))


def npy(values, shape, kind):
    words = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(words)) + words.encode() + values


def npz(arrays):
    """Arrays of a few numbers: nothing a person could move by, so these are no `good` ones."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values, shape, kind in arrays:
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), npy(values, shape, kind), zipfile.ZIP_DEFLATED)
    return file.getvalue()


def archives():
    source = (ROOT / "src/body/skeleton.rs").read_text()
    joints = re.findall(r'"([a-z_0-9]+)"', source[source.index("fn name") :])[:27][1:]
    common = {"version": 1, "skeleton": "muybridge-hanim-78", "joints": joints, "activity": "walking", "units": "", "blake3": "", "sources": ["a"]}
    model = common | {"format": "muybridge-model", "samples": 100, "root_channels": [], "synthetic": True, "parameter_unit": "m/s", "subjects": ["a"]}
    space = common | {"format": "muybridge-space", "cyclic": True, "intervals": 2, "timing_per_curve": False, "reference": 0, "members": ["a", "b"], "sources": ["a", "b"]}
    space |= {"attributes": ["b"]}
    number = lambda name, *shape: (name, struct.pack("<d", 1.0) * eval("*".join(map(str, shape))), shape, "<f8")
    for target, header, arrays in [
        ("model_npz", model, [number("mean", 7800), number("basis", 1, 7800), number("eigenvalues", 1), number("root_mean", 600)]
         + [number("root_basis", 1, 600), number("vectors", 1, 7800), number("roots", 1, 600)]
         + [number(n, 1) for n in ("parameters", "hip_heights_m", "durations_s")]),
        ("space_npz", space, [number("shapes", 2, 169), number("timings", 2, 2), number("hip_heights_m", 2), number("labels", 2, 1)]
         + [number("labelled", 2, 1), number("shape_mean", 169), number("shape_basis", 1, 169), number("shape_eigenvalues", 1)]
         + [number("timing_mean", 2), number("timing_basis", 1, 2), number("timing_eigenvalues", 1)]),
    ]:
        text = json.dumps(header).encode()
        path = OUT / target / "bad-hash"
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = [("header", text, (len(text),), "|u1"), number("mean_rotations", 26, 4)] + arrays
        path.write_bytes(npz(arrays))
        parts = [b"\n===" + name.encode() + b"\n" + npy(values, shape, kind) for name, values, shape, kind in arrays if len(values) < 5000]
        (path.parent / "bad-parts").write_bytes(b"".join(parts))


def archive_lies():
    part = lambda name, content: b"\n===" + name.encode() + b"\n" + content
    described = lambda words: b"\x93NUMPY\x01\x00" + struct.pack("<H", len(words)) + words
    for target in ("model_npz", "space_npz"):
        for name, content in [
            ("a_million_values", npy(b"12345678", (1_000_000,), "|u1")),
            ("more_than_memory", npy(b"12345678", (2**40, 2**40), "|u1")),
            ("deep_description", described(b"{'descr': " + b"(" * 900 + b"}")),
            ("long_description", b"\x93NUMPY\x02\x00\xff\xff\xff\xff{'descr'"),
        ]:
            seed(target, name, part("header", content), "bad")
        seed(target, "zeros", npz([("header", b" " * 3_000_000, (3_000_000,), "|u1")]), "bad")


def glb():
    floats = lambda *v: struct.pack(f"<{len(v)}f", *v)
    parts = [floats(0, 0, 0, 1, 0, 0, 0, 1, 0), bytes([0, 1, 0, 0] * 3), floats(*[1, 0, 0, 0] * 3), struct.pack("<3H", 0, 1, 2) + b"\0\0"]
    parts += [floats(*[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1] * 2), floats(0, 1), floats(0, 0, 0, 1, 0, 0.6, 0, 0.8), floats(*[0, 1, 0] * 6)]
    views, blob = [], b""
    for part in parts:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(part)})
        blob += part
    kinds = [(5126, 3, "VEC3"), (5121, 3, "VEC4"), (5126, 3, "VEC4"), (5123, 3, "SCALAR"), (5126, 2, "MAT4"), (5126, 2, "SCALAR")]
    kinds += [(5126, 2, "VEC4"), (5126, 6, "VEC3")]
    accessors = [{"bufferView": i, "componentType": c, "count": n, "type": t} for i, (c, n, t) in enumerate(kinds)]
    accessors[0] |= {"min": [0, 0, 0], "max": [1, 1, 0]}
    accessors[5] |= {"min": [0], "max": [1]}
    target = lambda path, sampler: {"sampler": sampler, "target": {"node": 1, "path": path}}
    samplers = [{"input": 5, "output": 6}, {"input": 5, "output": 7, "interpolation": "CUBICSPLINE"}]
    text = {
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": len(blob)}], "bufferViews": views, "accessors": accessors,
        "nodes": [{"name": "root", "children": [1]}, {"name": "leg", "translation": [0, 1, 0]}, {"mesh": 0, "skin": 0}],
        "scenes": [{"nodes": [0, 2]}], "skins": [{"joints": [0, 1], "inverseBindMatrices": 4}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "indices": 3}]}],
        "animations": [{"name": "walk", "channels": [target("rotation", 0), target("translation", 1)], "samplers": samplers}],
    }  # fmt: skip
    seed("glb", "leg", chunked(text, blob))
    # The same mesh and the same motion again and again, zeros that nothing holds, joints that are no bones.
    drawn = [{"primitives": text["meshes"][0]["primitives"] * 300}]
    seed("glb", "same_mesh", chunked(text | {"meshes": drawn, "nodes": text["nodes"] + [{"mesh": 0}] * 1000}, blob), "bad")
    many = text["animations"][0] | {"channels": [target("rotation", 0)]}
    seed("glb", "many_bones", chunked(text | {"nodes": text["nodes"] + [{}] * 8000, "animations": [many] * 200}, blob), "bad")
    for name, moved in [("unknown_path", {"node": 1, "path": "ro,ation"}), ("target_beyond", {"node": 9, "path": "rotation"})]:
        moving = text["animations"][0] | {"channels": [{"sampler": 0, "target": moved}]}
        seed("glb", name, chunked(text | {"animations": [moving]}, blob), "bad")
    seed("glb", "no_accessors", chunked(text | {"accessors": []}, blob), "bad")
    sparse = {"count": 1, "indices": {"bufferView": 3, "componentType": 5123}, "values": {"bufferView": 0}}
    zeros = accessors[0] | {"count": 2**31, "sparse": sparse}
    del zeros["bufferView"]
    seed("glb", "zeros", chunked(text | {"accessors": [zeros] + accessors[1:]}, blob), "bad")
    short = {"count": 3, "indices": {"bufferView": 3, "componentType": 5125}, "values": {"bufferView": 5}}
    seed("glb", "short_sparse", chunked(text | {"accessors": [accessors[0] | {"sparse": short}] + accessors[1:]}, blob), "bad")
    seed("glb", "holder_as_joint", chunked(text | {"skins": [{"joints": [0, 2], "inverseBindMatrices": 4}]}, blob))
    shorter = bytearray(chunked(text, blob))
    shorter[8:12] = bytes([3, 0, 0, 0])
    seed("glb", "shorter_than_its_header", bytes(shorter), "bad")
    seed("glb", "no_items", chunked(text | {"accessors": [accessors[0] | {"count": 0}] + accessors[1:]}, blob), "bad")


def chunked(text, blob):
    words = json.dumps(text, separators=(",", ":")).encode()
    words += b" " * (-len(words) % 4)
    chunks = struct.pack("<I4s", len(words), b"JSON") + words + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


calib()
rigs()
mocap()
seed("c3d", "intel", c3d(False, 84))
seed("c3d", "mips", c3d(True, 86))
seed("c3d", "dec", c3d(True, 85))
c3d_lies()
maps()
archives()
archive_lies()
glb()
