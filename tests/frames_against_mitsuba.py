"""How many frames lasertrace takes, from light to points, while Mitsuba 3 renders the direct light of one.

    python3 tests/frames_against_mitsuba.py LASERTRACE OUT [TRIANGLES]

A thin line on a wavy plate of a million triangles, 2048 × 1088 pixels, all threads. Ours: frames of a scan with
speckle, noise and points, in focus, by its manifest's `seconds_frames`. Theirs: `llvm_ad_mono`, integrator `direct`,
4 samples a pixel, no speckle and no sensor, after two images in which its kernels are compiled. Both are timed in
turn; the figure is the median of ratios, of which 100 is aimed at. Exits with 1 where the two do not see the same
line: as many columns, to 5 %.
"""
import json
import os
import shutil
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np

import mitsuba_line
import stl

ROUNDS = 7
FRAMES = 100
SIZE = (2048, 1088)
PITCH_MM = 5.5e-3
FOCAL_MM = 25.0
FOCUS_MM = 252.0
CAMERA = [0, -126, 218.2]
FAN_DEG = 24.0
STAND_OFF = 200.0
WAIST_MM = 0.08

SCENE = """
seed = 1
speckle = true
[part]
mesh = { file = "part.stl", unit = "mm" }
reflectance = 0.5
[laser]
wavelength_nm = 660
power_mw = 20
waist_radius_um = %(waist)g
waist_distance_mm = %(stand_off)g
position_mm = [0, 0, %(stand_off)g]
direction = [0, 0, -1]
line = { fan_deg = %(fan)g, profile = "uniform", direction = [1, 0, 0] }
[camera]
focal_length_mm = %(focal)g
f_number = 8
focus_distance_mm = %(focus)g
resolution_px = [%(columns)d, %(rows)d]
pixel_pitch_um = %(pitch)g
position_mm = %(camera)s
look_at_mm = [0, 0, 0]
column_axis = [1, 0, 0]
exposure_ms = 0.15
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
black_level_dn = 8
read_noise_e = 10
[scan]
start_mm = [0, -%(half)g, 0]
direction = [0, 1, 0]
step_mm = 0.05
frames = %(frames)d
[model]
defocus_model = "none"
"""


def wavy(triangles):
    """Vertices and triangles of a plate of 90 mm."""
    cells = round((triangles / 2) ** 0.5)
    along = np.arange(cells + 1) / cells * 90 - 45
    x, y = np.meshgrid(along, along)
    z = 2 * np.sin(x / 7) + np.sin(y / 5 + x / 11)
    first = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = first, first + 1, first + cells + 2, first + cells + 1
    faces = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1).reshape(-1, 3)
    return np.stack([x, y, z], -1).reshape(-1, 3).astype("<f4"), faces.astype("<u4")


def main():
    program, out = os.path.abspath(sys.argv[1]), sys.argv[2]
    os.makedirs(out, exist_ok=True)
    os.chdir(out)
    points, faces = wavy(int(float(sys.argv[3])) if len(sys.argv) > 3 else 1_000_000)
    stl.write("part.stl", points[faces])
    with open("scene.toml", "w") as file:
        file.write(SCENE % {
            "waist": WAIST_MM * 1e3, "stand_off": STAND_OFF, "fan": FAN_DEG, "focal": FOCAL_MM, "focus": FOCUS_MM,
            "columns": SIZE[0], "rows": SIZE[1], "pitch": PITCH_MM * 1e3, "camera": CAMERA, "half": FRAMES * 0.025,
            "frames": FRAMES})
    sensor = {"size": SIZE, "pitch": PITCH_MM, "focal": FOCAL_MM, "focus": FOCUS_MM, "position": CAMERA,
              "target": [0, 0, 0]}
    laser = {"waist": WAIST_MM, "stand_off": STAND_OFF, "fan": FAN_DEG}
    scene = mitsuba_line.scene(points, faces, sensor, laser, "part.ply")

    def their_seconds(seed):
        start = time.perf_counter()
        image = np.array(mi.render(scene, seed=seed))
        return time.perf_counter() - start, image

    def our_seconds():
        shutil.rmtree("scan", ignore_errors=True)
        subprocess.run([program, "scan", "scene.toml", "-o", "scan", "--quiet"], check=True, stdout=subprocess.DEVNULL)
        with open("scan/manifest.json") as file:
            seconds = json.load(file)["seconds_frames"] / FRAMES
        with open("scan/summary.json") as file:
            return seconds, json.load(file)["points"] / FRAMES

    for seed in range(2):
        their_seconds(seed)
    ratios, ours, others = [], [], []
    for seed in range(ROUNDS):
        other, image = their_seconds(seed + 2)
        own, found = our_seconds()
        ratios.append(other / own)
        ours.append(own)
        others.append(other)
    lit = (image.reshape(SIZE[1], SIZE[0]).max(axis=0) > 0).sum()
    low, middle, high = np.quantile(ratios, [0.25, 0.5, 0.75])
    print("%.1f frames for one image of Mitsuba %s (quartiles %.1f to %.1f of %d): %.2f ms and %.0f ms; "
          "%d columns lit there, %.0f points a frame here"
          % (middle, mi.__version__, low, high, ROUNDS, 1e3 * np.median(ours), 1e3 * np.median(others), lit, found))
    sys.exit(int(abs(lit / found - 1) >= 0.05))


main()
