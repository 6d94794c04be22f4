"""The chart of accuracy against speed with Mitsuba 3 as a point.

    python3 tests/chart_beside_mitsuba.py LASERTRACE SCENE OUT

Mitsuba (`llvm_ad_mono`, one thread) renders the direct light of frames of SCENE, a straight scan of an STL in
millimetres like `scenes/accuracy/scene.toml`, 4 samples a pixel, no speckle and no sensor noise, five times each after
two images in which its kernels are compiled. Its images become counts with as much light in all as this program's
images have; `lasertrace chart --beside` finds their lines as those of its own. Exits with 1 where it finds less than
95 of 100 of them, which says that the two do not see the same part.
"""
import json
import os
import subprocess
import sys
import time
import tomllib

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsuba_line
import stl

TIMES = 5
FRAMES = 3


def main():
    program, path, out = sys.argv[1:]
    with open(path, "rb") as file:
        scene = tomllib.load(file)
    camera, laser, scan = scene["camera"], scene["laser"], scene["scan"]
    mesh = os.path.join(os.path.dirname(path), scene["part"]["mesh"]["file"])
    points = np.ascontiguousarray(stl.read(mesh).reshape(-1, 3))
    faces = np.arange(len(points), dtype="<u4").reshape(-1, 3)
    os.makedirs(out, exist_ok=True)
    inside = lambda name: os.path.join(out, name)
    sensor = {"size": tuple(camera["resolution_px"]), "pitch": camera["pixel_pitch_um"] * 1e-3,
              "focal": camera["focal_length_mm"], "focus": camera["focus_distance_mm"],
              "position": camera["position_mm"], "target": camera["look_at_mm"]}
    line = {"waist": laser["waist_radius_um"] * 1e-3, "stand_off": laser["position_mm"][2],
            "fan": laser["line"]["fan_deg"]}
    black, full = camera["black_level_dn"], 2 ** camera["bit_depth"] - 1
    dr.set_thread_count(1)
    frames = []
    for i in range(FRAMES):
        number = int((i + 0.5) * scan["frames"] / FRAMES)
        at = np.array(scan["start_mm"]) + number * scan["step_mm"] * np.array(scan["direction"])
        theirs = mitsuba_line.scene(points, faces, sensor, line, inside("part.ply"), at)
        ms = []
        for seed in range(2 + TIMES):
            start = time.perf_counter()
            light = np.array(mi.render(theirs, seed=seed))
            ms.append(1e3 * (time.perf_counter() - start))
        subprocess.run([program, "render", path, "--frame", str(number), "-o", inside("ours"), "--quiet"], check=True,
                       stdout=subprocess.DEVNULL)
        ours = np.array(mi.Bitmap(inside(f"ours/frame-{number:06}.png"))).astype(float) - black
        light = light.reshape(sensor["size"][1], sensor["size"][0])
        counts = np.clip(np.rint(black + light * ours.sum() / light.sum()), 0, full)
        mi.Bitmap(counts.astype(np.uint16)[:, :, None]).write(inside(f"theirs{number}.png"))
        frames.append({"frame": number, "ms": ms[2:], "image": f"theirs{number}.png"})
    name = f"Mitsuba {mi.__version__}: direct light, 4 samples a pixel"
    with open(inside("beside.json"), "w") as file:
        json.dump({"name": name, "frames": frames}, file)
    done = subprocess.run([program, "chart", path, "-o", out, "--beside", inside("beside.json"), "--quiet", "--json"], check=True,
                          capture_output=True, text=True)
    chart = json.loads(done.stdout)
    beside, chosen = chart["beside"], next(row for row in chart["rows"] if row["chosen"])
    print("%s: %.1f ms a frame, the plan %.2f ms, one core; scatter against geometry %.2f µm, the plan's %.2f; %.1f %% of "
          "points lost" % (name, beside["ms"][1], chosen["ms"][1], beside["scatter"]["half_width_68_um"],
                           chosen["scatter"]["half_width_68_um"], 100 * beside["error"]["lost"]))
    sys.exit(int(beside["error"]["lost"] > 0.05))


main()
