"""Light reflected more than once, against Mitsuba 3: totals and row profiles of corners, a pocket and a real part.

    python3 tests/against_mitsuba.py LIGHT_APART OUT [SAMPLES]

Mitsuba's `ptracer` follows light from a projector of the same shape: a fan of even power per angle, Gaussian
across, from a point (the laser's waist lies at its aperture and is small). Its metals leave out what several facets
reflect, which off the lobe is as bright as what one does; so does the example `light_apart`. Both programs' images are
divided by their own light reflected once.
Prints one line a scene, and exits with 1 where a total or a row is off by more than 1 % and five standard errors of
both, known from 16 images each: by Student's t of 15 degrees of freedom a false alarm in 6000 for each of some hundred rows.
"""
import os
import subprocess
import sys

import mitsuba as mi
import numpy as np

import stl

mi.set_variant("scalar_rgb")
mi.set_log_level(mi.LogLevel.Error)

HERE = os.path.dirname(os.path.abspath(__file__))
IMAGES = 16  # of each program, with seeds of their own
PATHS = 1 << 18  # for each of ours
WAIST_MM = 0.05
WAVELENGTH_MM = 660e-6
STAND_OFF = 200.0
FAN_DEG = 12.0
SIZE = (160, 120)
HALF_VIEW_DEG = 7.0


def placed(triangles):
    """With its top's middle 8 mm above the origin, 40 mm wide."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    middle = np.array([*((low + high) / 2)[:2], high[2]])
    return (triangles - middle) * 40 / (high - low)[:2].max() + [0, 0, 8]


def ply(path, triangles):
    count = len(triangles)
    faces = np.zeros(count, dtype=np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    faces["n"], faces["v"] = 3, np.arange(3 * count).reshape(-1, 3)
    with open(path, "wb") as file:
        file.write(b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty float x\nproperty float y\n"
                   b"property float z\nelement face %d\nproperty list uchar int vertex_indices\nend_header\n"
                   % (3 * count, count))
        file.write(triangles.reshape(-1, 3).astype("<f4").tobytes() + faces.tobytes())


def projector(look_at):
    """Texture over the tangents of a pinhole that looks down."""
    half = np.tan(np.radians(FAN_DEG / 2))
    # 1/e² half width over distance, with what the waist adds at the stand-off.
    divergence = np.hypot(WAVELENGTH_MM / np.pi / WAIST_MM, WAIST_MM / STAND_OFF)
    # Texels are square on the projector's plane, eight to a standard deviation.
    columns = 1024
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * half
    rows = 2 * int(np.ceil(4 * divergence / (2 * half / columns)))
    y = (np.arange(rows) + 0.5 - rows / 2) * 2 * half / columns
    # Of the fan's middle distance, which the beam's width grows with.
    distance = np.sqrt(1 + x**2)
    # Even power per angle: cos² per tangent.
    power = np.exp(-2 * (y[:, None] / (divergence * distance)) ** 2) / distance**3
    # What is dark makes `ptracer` return infinity.
    image = np.maximum(power, 1e-8).astype(np.float32)[:, :, None]
    return {
        "type": "projector",
        "to_world": look_at,
        "fov": FAN_DEG,
        "fov_axis": "x",
        "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True, "filter_type": "nearest"},
    }


def their_scene(mesh, bsdf, camera, target, depth):
    return mi.load_dict({
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
            "sampler": {"type": "independent"},
        },
        "integrator": {"type": "ptracer", "max_depth": depth, "rr_depth": 1000, "hide_emitters": True},
    })


def theirs(scene, samples, seed):
    return np.array(mi.render(scene, seed=seed, spp=samples))[:, :, 0].astype(float)


SCENE = """
seed = 1
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
column_axis = [1, 0, 0]
exposure_ms = 1e4
quantum_efficiency = 0.5
gain_dn_per_e = 0.068
bit_depth = 10
full_well_e = 15000
[scan]
direction = [0, 1, 0]
step_mm = 0.2
frames = 1
[model]
defocus_model = "none"
# The ends of the fan are sharp, and cut pixels.
samples_per_side = %(samples)d
"""


def ours(program, out, mesh, surface, camera, target, most, paths=PATHS, samples=16):
    """Images of light reflected once and of more, over all of the first; and what the program prints."""
    image_distance = 25 * 190 / (190 - 25)
    pitch = image_distance * np.tan(np.radians(HALF_VIEW_DEG)) / (SIZE[0] / 2)
    path, images = os.path.join(out, "scene.toml"), os.path.join(out, "images.f32")
    with open(path, "w") as file:
        file.write(SCENE % {"mesh": os.path.abspath(mesh), "surface": surface, "columns": SIZE[0], "rows": SIZE[1],
                            "pitch": pitch * 1e3, "camera": list(camera), "target": list(target), "samples": samples})
    said = subprocess.run([program, path, images, str(most), str(paths), str(IMAGES)], check=True,
                          stdout=subprocess.PIPE, text=True).stdout
    # Irradiance on the sensor is radiance times cos⁴.
    x = (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) * pitch
    y = (np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) * pitch
    cos4 = (image_distance**2 / (image_distance**2 + x[None, :] ** 2 + y[:, None] ** 2)) ** 2
    direct, *more = np.fromfile(images, "<f4").astype(float).reshape(-1, SIZE[1], SIZE[0]) / cos4
    return direct / direct.sum(), [image / direct.sum() for image in more], said


def metal(alpha):
    """Mitsuba takes masking of both directions as independent: light is 1 % less there where both are 74° (α = 0.2) or 82°
    (0.1) off the normal, and more beyond."""
    return ("[part.surface]\nmetal = { n = 1.6575, k = 9.2238, roughness = %g }" % alpha,
            {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "eta": 1.6575, "k": 9.2238})


def matt(share):
    return ("reflectance = %g" % share, {"type": "diffuse", "reflectance": share})


def compare(name, program, out, part, kind, camera, target, most, samples):
    surface, bsdf = kind
    mesh = os.path.join(out, "part.ply")
    ply(mesh, stl.read(part).astype(float))
    once, more, _ = ours(program, out, part, surface, camera, target, most)
    direct, whole = [[theirs(their_scene(mesh, bsdf, camera, target, depth), samples, first + seed)
                      for seed in range(IMAGES)] for depth, first in ((2, 100), (most + 1, 0))]
    sums = np.array([image.sum() for image in direct])
    scale_error = sums.std(ddof=1) / IMAGES**0.5 / sums.mean()
    mine, other = [image + once for image in more], [image / sums.mean() for image in whole]

    def known(images):
        """Means and standard errors of both programs' images."""
        means = [np.mean(i, axis=0) for i in images]
        spread = np.sqrt(sum(np.var(i, axis=0, ddof=1) / IMAGES for i in images) + (scale_error * means[1]) ** 2)
        return means, spread

    (a, b), error = known([[image.sum() for image in images] for images in (mine, other)])
    # Eight rows together; those with at least 1 % of the brightest.
    means, spread = known([np.array(images).sum(axis=2).reshape(IMAGES, -1, 8).sum(axis=2) for images in (mine, other)])
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
    samples = int(sys.argv[3]) if len(sys.argv) > 3 else 24
    os.makedirs(out, exist_ok=True)
    corner, pocket = [os.path.join(HERE, "../scenes/corner", name) for name in ("corner.stl", "pocket.stl")]
    beside, middle = (0, -100, 170), (0, 0, 8)
    cases = [
        ("matt corner, 2 reflections", corner, matt(0.5), beside, middle, 2),
        ("matt corner, 3 reflections", corner, matt(0.5), beside, middle, 3),
        ("aluminium corner, 3 reflections", corner, metal(0.2), beside, middle, 3),
        ("aluminium pocket, 4 reflections", pocket, metal(0.1), (0, -70, 170), (0, 0, -5), 4),
    ]
    real = os.path.join(HERE, "../../shared/data/meshes/trimesh_octagonal_pocket.stl")
    if os.path.exists(real):
        part = os.path.join(out, "part.stl")
        stl.write(part, placed(stl.read(real).astype(float)))
        cases.append(("octagonal pocket of ../shared/data, matt", part, matt(0.8), beside, middle, 4))
        cases.append(("octagonal pocket of ../shared/data, aluminium", part, metal(0.1), beside, middle, 4))
    else:
        print("no real part: ../shared/data is absent", flush=True)
    good = [compare(name, program, out, *rest, samples) for name, *rest in cases]
    print("%d of %d scenes" % (sum(good), len(good)))
    sys.exit(0 if all(good) else 1)


if __name__ == "__main__":
    main()
