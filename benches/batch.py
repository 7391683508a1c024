#!/usr/bin/env python3
"""What a batch costs and survives: 60 sessions of which 6 are broken, 20 kills, 10 to 200 sessions, optionally Slurm.

    python3 benches/batch.py target/release/muybridge /tmp/batch-bench [--sessions 60] [--kills 20] [--counts 10,50,200] [--threads 1] [--slurm]

Prints one line per figure. The footage is the phantom's: 6 frames of 160x120 px per session. Takes about twenty minutes on
two idle cores; other load makes the figures of cores and seconds worse.
"""
import argparse, hashlib, json, os, random, resource, shutil, subprocess, sys, time

parser = argparse.ArgumentParser()
parser.add_argument("muybridge")
parser.add_argument("place")
parser.add_argument("--sessions", type=int, default=60)
parser.add_argument("--kills", type=int, default=20)
parser.add_argument("--counts", default="10,50,200")
parser.add_argument("--threads", type=int, help="of the batches of --counts; all cores without it")
parser.add_argument("--slurm", action="store_true")
args = parser.parse_args()
PROGRAM, PLACE = os.path.abspath(args.muybridge), os.path.abspath(args.place)
RIG = os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "calib", "phantom_lab.toml")
FRAMES = 6


def run(*arguments, check=True):
    done = subprocess.run([PROGRAM, *map(str, arguments)], capture_output=True, text=True)
    if check and done.returncode != 0:
        sys.exit(f"{arguments}: {done.stderr}")
    return done


def small_rig(path, scale=0.25):
    """The phantom's rig with pictures of a quarter of the size."""
    lines = []
    for line in open(RIG):
        numbers = [float(n) for n in line.partition("=")[2].replace("[", " ").replace("]", " ").replace(",", " ").split()] \
            if line.startswith(("size", "matrix")) else []
        if line.startswith("size"):
            line = "size = [ %d, %d ]\n" % tuple(n * scale for n in numbers)
        elif line.startswith("matrix"):
            fx, _, cx, _, fy, cy = numbers[:6]
            centre = [(c + 0.5) * scale - 0.5 for c in (cx, cy)]
            line = f"matrix = [ [ {fx * scale}, 0.0, {centre[0]} ], [ 0.0, {fy * scale}, {centre[1]} ], [ 0.0, 0.0, 1.0 ] ]\n"
        lines.append(line)
    open(path, "w").writelines(lines)


def film():
    """Footage of a walk to cut sessions from."""
    shutil.rmtree(PLACE, ignore_errors=True)
    os.makedirs(PLACE)
    at = lambda name: os.path.join(PLACE, name)
    small_rig(at("rig.toml"))
    run("model", "synthetic", "--activity", "walking", "-o", at("walking.npz"))
    run("demo", "-o", at("demo"), "--frames", 10)
    run("render", at("demo/generated/walking_5kmh.bvh"), "--rig", at("rig.toml"), "--fps", 15, "--to", 2, "-o", at("film"))
    return at("film")


def study(name, film, count, broken):
    folder = os.path.join(PLACE, name)
    frames = sorted(os.listdir(os.path.join(film, "cam_00")))
    for i in range(count):
        session, first = os.path.join(folder, f"day_{i // 10}", f"walk_{i}"), i % (len(frames) - FRAMES + 1)
        for camera in ("cam_00", "cam_01", "cam_02"):
            os.makedirs(os.path.join(session, camera))
            shutil.copy(os.path.join(film, f"{camera}_background.png"), session)
            for picture in frames[first:first + FRAMES]:
                shutil.copy(os.path.join(film, camera, picture), os.path.join(session, camera))
        shutil.copy(os.path.join(film, "Calib.toml"), session)
        if i in broken:
            broken[i](session)
    with open(os.path.join(folder, "muybridge.toml"), "w") as options:
        options.write(f'fps = 15\nmodel = "{PLACE}/walking.npz"\n')
    return folder


def first(session, camera, index=0):
    folder = os.path.join(session, camera)
    return os.path.join(folder, sorted(os.listdir(folder))[index])


def write(path, text):
    with open(path, "w") as file:
        file.write(text)


def six_ways():
    """Six ways in which sessions come broken."""
    return {
        3: lambda s: os.remove(os.path.join(s, "Calib.toml")),
        11: lambda s: os.truncate(first(s, "cam_01", 4), 300),
        20: lambda s: os.remove(first(s, "cam_02", 5)),
        27: lambda s: shutil.rmtree(os.path.join(s, "cam_00")),
        41: lambda s: write(os.path.join(s, "muybridge.toml"), "activty = \"walking\"\n"),
        59: lambda s: [shutil.copy(os.path.join(s, f"{c}_background.png"), first(s, c, i)) for c in ("cam_00", "cam_01", "cam_02") for i in range(FRAMES)],
    }


def digest(results):
    """One hash of all files that must not depend on how the batch ran."""
    total, files = hashlib.sha256(), 0
    for folder, below, names in sorted(os.walk(results)):
        if os.path.relpath(folder, results).split(os.sep)[0] in (".work", "logs"):
            continue
        for name in sorted(names):
            if name not in ("status.json", "index.html"):
                path = os.path.join(folder, name)
                total.update(os.path.relpath(path, results).encode() + b"\0" + open(path, "rb").read())
                files += 1
    return total.hexdigest()[:16], files


def timed(folder, results):
    before, clock = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    load = os.getloadavg()[0]
    done = run("batch", folder, "-o", results, check=False)
    seconds, after = time.monotonic() - clock, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done, seconds, cpu, load


def occupied(results, seconds, jobs):
    """Share of the time in which all of the jobs had a session in work, whatever else the machine did."""
    worked = 0.0
    for folder, _, names in os.walk(results):
        if "status.json" in names and ".work" not in folder:
            worked += json.load(open(os.path.join(folder, "status.json")))["seconds"] or 0.0
    return worked / (seconds * jobs)


def supervisor_peak_mb(folder, results):
    """Largest resident memory of the supervising process alone, sampled."""
    threads = ["--threads", str(args.threads)] if args.threads else []
    process = subprocess.Popen([PROGRAM, *threads, "batch", folder, "-o", results], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    peak, clock, ended = 0.0, time.monotonic(), None
    ticks = lambda: sum(int(v) for v in open(f"/proc/{process.pid}/stat").read().rsplit(")", 1)[1].split()[11:15])
    cpu = 0
    while process.poll() is None:
        try:
            lines = open(f"/proc/{process.pid}/status").read().splitlines()
            peak = max([peak] + [int(l.split()[1]) / 1e3 for l in lines if l.startswith("VmHWM")])
            cpu = ticks()
        except (OSError, IndexError):
            pass
        time.sleep(0.05)
    return peak, time.monotonic() - clock, cpu / os.sysconf("SC_CLK_TCK")


source = film()
folder = study("study", source, args.sessions, {i: f for i, f in six_ways().items() if i < args.sessions})
calm = os.path.join(PLACE, "calm")
done, seconds, cpu, load = timed(folder, calm)
print(f"undisturbed: exit {done.returncode}, {seconds:.1f} s, cores {cpu / seconds:.2f} of {os.cpu_count()} "
      f"(load before {load:.1f}), {100 * occupied(calm, seconds, os.cpu_count()):.1f} % of {os.cpu_count()} jobs in work")
print("\n".join(done.stdout.splitlines()[-8:]))
again, seconds, _, _ = timed(folder, calm)
print(f"again: {again.stdout.splitlines()[0]}; {seconds:.2f} s")
expected = digest(calm)

results, generator = os.path.join(PLACE, "killed"), random.Random(8)
for _ in range(args.kills):
    process = subprocess.Popen([PROGRAM, "batch", folder, "-o", results], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    time.sleep(generator.uniform(0.2, 12.0))
    process.kill()
    process.wait()
done = run("batch", folder, "-o", results, check=False)
print(f"{args.kills} kills, resumed: exit {done.returncode}, {digest(results)} against {expected}, same bytes: {digest(results) == expected}")

if args.slurm:
    results = os.path.join(PLACE, "slurm")
    clock = time.monotonic()
    print(run("batch", folder, "-o", results, "--engine", "slurm").stdout.splitlines()[0])
    while not os.path.exists(os.path.join(results, "summary.csv")):
        time.sleep(0.5)
    print(f"Slurm: {time.monotonic() - clock:.1f} s, same bytes: {digest(results) == expected}")
    print(run("batch", folder, "-o", results, "--engine", "slurm").stdout.splitlines()[0])

for count in map(int, filter(None, args.counts.split(","))):
    many = study(f"many_{count}", source, count, {})
    peak, seconds, cpu = supervisor_peak_mb(many, os.path.join(PLACE, f"results_{count}"))
    print(f"{count} sessions: {seconds:.1f} s, {seconds / count:.3f} s and {cpu / count:.3f} CPU s a session, supervisor {peak:.0f} MB, "
          f"{100 * occupied(os.path.join(PLACE, f'results_{count}'), seconds, args.threads or os.cpu_count()):.1f} % of the jobs in work")
