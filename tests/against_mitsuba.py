"""Light reflected more than once, against Mitsuba 3: totals and row profiles of corners, a pocket and a real part.

    python3 tests/against_mitsuba.py LASERTRACE OUT [SAMPLES]

Mitsuba's `ptracer` follows light from a projector of the same shape: a fan of even power per angle, Gaussian
across, from a point (the laser's waist lies at its aperture and is small). Both programs' images are divided by their own light reflected once.
Prints one line a scene, and exits with 1 where a total or a row is off by more than 1 % and five standard errors of
both.
"""
import os
import struct
import subprocess
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
mi.set_log_level(mi.LogLevel.Error)

HERE = os.path.dirname(os.path.abspath(__file__))
IMAGES = 4  # of each program, with seeds of their own
WAIST_MM = 0.05
WAVELENGTH_MM = 660e-6
STAND_OFF = 200.0
FAN_DEG = 12.0
SIZE = (160, 120)
HALF_VIEW_DEG = 7.0


def triangles_of(path):
    with open(path, "rb") as file:
        data = file.read()
    count = struct.unpack("<I", data[80:84])[0]
    rows = np.frombuffer(data[84:84 + 50 * count], dtype=np.dtype([("n", "<3f4"), ("v", "<9f4"), ("a", "<u2")]))
    return rows["v"].reshape(-1, 3, 3).astype(float)


def placed(triangles):
    """With its top's middle 8 mm above the origin, 40 mm wide."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    middle = np.array([*((low + high) / 2)[:2], high[2]])
    return (triangles - middle) * 40 / (high - low)[:2].max() + [0, 0, 8]


def stl(path, triangles):
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    rows = np.zeros(len(triangles), dtype=np.dtype([("n", "<3f4"), ("v", "<9f4"), ("a", "<u2")]))
    rows["n"], rows["v"] = normals, triangles.reshape(-1, 9)
    with open(path, "wb") as file:
        file.write(b"\0" * 80 + struct.pack("<I", len(rows)) + rows.tobytes())


def ply(path, triangles):
    points = triangles.reshape(-1, 3)
    with open(path, "w") as file:
        file.write("ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"
                   "element face %d\nproperty list uchar int vertex_indices\nend_header\n"
                   % (len(points), len(triangles)))
        np.savetxt(file, points, fmt="%.9g")
        for i in range(len(triangles)):
            file.write("3 %d %d %d\n" % (3 * i, 3 * i + 1, 3 * i + 2))


def projector(look_at):
    """Texture over the tangents of a pinhole that looks down; across the sheet 1/e² at tan = divergence."""
    half = np.tan(np.radians(FAN_DEG / 2))
    divergence = WAVELENGTH_MM / np.pi / WAIST_MM
    # Texels are square on the projector's plane, eight to a standard deviation.
    columns = 1024
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * half
    rows = 2 * int(np.ceil(4 * divergence / (2 * half / columns)))
    y = (np.arange(rows) + 0.5 - rows / 2) * 2 * half / columns
    # Even power per angle: cos² per tangent. Width grows with the distance from the aperture.
    power = np.outer(np.exp(-2 * (y / divergence) ** 2), 1 / (1 + x**2))
    # What is dark makes `ptracer` return infinity.
    image = np.maximum(power, 1e-8).astype(np.float32)[:, :, None]
    return {
        "type": "projector",
        "to_world": look_at,
        "fov": FAN_DEG,
        "fov_axis": "x",
        "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"},
    }


def theirs(mesh, bsdf, camera, target, depth, samples, seed):
    scene = mi.load_dict({
        "type": "scene",
        "part": {"type": "ply", "filename": mesh, "face_normals": True,
                 "bsdf": {"type": "twosided", "bsdf": bsdf}},
        "laser": projector(mi.ScalarTransform4f().look_at(
            [0, 0, STAND_OFF], [0, 0, 0], [0, 1, 0])),
        "sensor": {
            "type": "perspective", "fov": 2 * HALF_VIEW_DEG, "fov_axis": "x",
            "to_world": mi.ScalarTransform4f().look_at(list(camera), list(target), [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "pixel_format": "luminance",
                     "rfilter": {"type": "box"}, "component_format": "float32"},
            "sampler": {"type": "independent", "sample_count": samples},
        },
        "integrator": {"type": "ptracer", "max_depth": depth, "rr_depth": 1000, "hide_emitters": True},
    })
    return np.array(mi.render(scene, seed=seed, spp=samples))[:, :, 0].astype(float)


SCENE = """
seed = %(seed)d
speckle = false
[part]
mesh = { file = "%(mesh)s", unit = "mm" }
%(surface)s
[laser]
wavelength_nm = 660
power_mw = 10
waist_radius_um = 50
waist_distance_mm = 0
position_mm = [0, 0, 200]
direction = [0, 0, -1]
line = { fan_deg = 12, profile = "uniform", direction = [1, 0, 0] }
[camera]
focal_length_mm = 25
f_number = 1000
focus_distance_mm = 190
resolution_px = [%(columns)d, %(rows)d]
pixel_pitch_um = %(pitch).9f
position_mm = %(camera)s
look_at_mm = %(target)s
columns = [1, 0, 0]
exposure_ms = 1e4
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
[scan]
direction = [0, 1, 0]
step_mm = 0.2
frames = 1
[plan]
reflections = %(most)d
blur = "none"
# The ends of the fan are sharp, and cut pixels.
samples_per_side = 16
"""


def ours(program, out, mesh, surface, camera, target, most, seed):
    image_distance = 25 * 190 / (190 - 25)
    pitch = image_distance * np.tan(np.radians(HALF_VIEW_DEG)) / (SIZE[0] / 2)
    path = os.path.join(out, "scene.toml")
    with open(path, "w") as file:
        file.write(SCENE % {"seed": seed, "mesh": os.path.abspath(mesh), "surface": surface, "columns": SIZE[0],
                            "rows": SIZE[1], "pitch": pitch * 1e3, "camera": list(camera), "target": list(target),
                            "most": most})
    subprocess.run([program, "render", path, "--frame", "0", "-o", out, "--quiet"], check=True)
    bitmap = mi.Bitmap(os.path.join(out, "frame-000000.exr"))
    layers = {name.rstrip("."): np.array(part)[:, :, 0].astype(float) if np.array(part).ndim == 3
              else np.array(part).astype(float) for name, part in bitmap.split()}
    if "direct" not in layers:
        data, names = np.array(bitmap), [field.name for field in bitmap.struct_()]
        layers = {name: data[:, :, i].astype(float) for i, name in enumerate(names)}
    # Irradiance on the sensor is radiance times cos⁴.
    x = (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) * pitch
    y = (np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) * pitch
    cos4 = (image_distance**2 / (image_distance**2 + x[None, :] ** 2 + y[:, None] ** 2)) ** 2
    return layers["direct"] / cos4, layers["reflections"] / cos4


def metal(alpha):
    # What several facets reflect at a rough surface Mitsuba leaves out; this is smooth enough for 1 %.
    return ("[part.surface]\nmetal = { n = 1.6575, k = 9.2238, roughness = %g }" % alpha,
            {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "eta": 1.6575, "k": 9.2238})


def matt(share):
    return ("reflectance = %g" % share, {"type": "diffuse", "reflectance": share})


def compare(name, program, out, stl, kind, camera, target, most, samples):
    surface, bsdf = kind
    mesh = os.path.join(out, "part.ply")
    ply(mesh, triangles_of(stl))
    once, more = [], []
    for seed in range(IMAGES):
        direct, ghosts = ours(program, out, stl, surface, camera, target, most, seed)
        once.append(direct)
        more.append(ghosts / direct.sum())
    direct = [theirs(mesh, bsdf, camera, target, 2, samples, 100 + seed) for seed in range(IMAGES)]
    whole = [theirs(mesh, bsdf, camera, target, most + 1, samples, seed) for seed in range(IMAGES)]
    scale = np.mean([image.sum() for image in direct])
    other = [image / scale for image in whole]
    mine = [image + once[0] / once[0].sum() for image in more]
    totals = [np.array([image.sum() for image in images]) for images in (mine, other)]
    error = np.sqrt(sum(t.var(ddof=1) / IMAGES for t in totals)
                    + (totals[1].mean() * np.std([i.sum() for i in direct], ddof=1) / scale) ** 2 / IMAGES)
    a, b = totals[0].mean(), totals[1].mean()
    rows = [np.array([image.sum(axis=1) for image in images]) for images in (mine, other)]
    # Eight rows together; those with at least 1 % of the brightest.
    rows = [r.reshape(IMAGES, -1, 8).sum(axis=2) for r in rows]
    means = [r.mean(axis=0) for r in rows]
    spread = np.sqrt(sum(r.var(axis=0, ddof=1) / IMAGES for r in rows))
    lit = means[1] > 0.01 * means[1].max()
    off = np.abs(means[0] - means[1])[lit]
    beyond = off > 0.01 * means[1][lit] + 5 * spread[lit]
    good = abs(a - b) < 0.01 * b + 5 * error and not beyond.any()
    print("%s: %.4f here, %.4f there, over light reflected once; difference %+.2f %% ± %.2f %%; rows within %.1f %% "
          "(noise %.1f %%): %s" % (name, a, b, 100 * (a / b - 1), 100 * error / b,
                                   100 * (off / means[1][lit]).max(), 100 * (spread[lit] / means[1][lit]).max(),
                                   "yes" if good else "NO"), flush=True)
    return good


def main():
    program, out = sys.argv[1:3]
    samples = int(sys.argv[3]) if len(sys.argv) > 3 else 128
    os.makedirs(out, exist_ok=True)
    corner, pocket = [os.path.join(HERE, "../scenes/corner", name) for name in ("corner.stl", "pocket.stl")]
    beside, middle = (0, -100, 170), (0, 0, 8)
    cases = [
        ("matt corner, 2 reflections", corner, matt(0.5), beside, middle, 2),
        ("matt corner, 3 reflections", corner, matt(0.5), beside, middle, 3),
        ("aluminium corner, 3 reflections", corner, metal(0.2), beside, middle, 3),
        ("aluminium pocket, 4 reflections", pocket, metal(0.2), (0, -70, 170), (0, 0, -5), 4),
    ]
    real = os.path.join(HERE, "../../shared/data/meshes/trimesh_octagonal_pocket.stl")
    if os.path.exists(real):
        part = os.path.join(out, "part.stl")
        stl(part, placed(triangles_of(real)))
        cases.append(("octagonal pocket of ../shared/data, matt", part, matt(0.8), beside, middle, 4))
        cases.append(("octagonal pocket of ../shared/data, aluminium", part, metal(0.2), beside, middle, 4))
    else:
        print("no real part: ../shared/data is absent", flush=True)
    good = [compare(name, program, out, *rest, samples) for name, *rest in cases]
    sys.exit(0 if all(good) else 1)


main()
