"""A thin laser line on a mesh, seen by a pinhole, in Mitsuba 3 (`llvm_ad_mono`): what both scripts that time it share."""
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_mono")
mi.set_log_level(mi.LogLevel.Error)


def scene(points, faces, sensor, laser, ply, at=(0, 0, 0)):
    """Direct light of a diffuse part with 4 samples a pixel, laser and camera moved by `at`; the mesh is written to the file
    `ply`.

    `sensor`: `size` (pixels), `pitch`, `focal`, `focus`, `position`, `target`, up along z. `laser`: `waist` (1/e² half
    width at `stand_off` below it), `fan` in degrees along x, looking down from the z of `stand_off`. Millimetres.
    """
    mesh = mi.Mesh("part", len(points), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = points.ravel()
    parameters["faces"] = faces.ravel()
    parameters.update()
    mesh.write_ply(ply)
    half = np.tan(np.radians(laser["fan"] / 2))
    # Rows of a pinhole's picture whose lines are 1/e² wide in all as the waist is at the stand-off.
    columns, line = 2048, 2 * laser["waist"] / laser["stand_off"]
    rows = 2 * int(np.ceil(4 * line / (2 * half / columns)))
    y = (np.arange(rows) + 0.5 - rows / 2) * 2 * half / columns
    image = np.repeat(np.exp(-2 * (y / (line / 2)) ** 2)[:, None, None], columns, axis=1).astype(np.float32)
    width, height = sensor["size"]
    image_distance = sensor["focal"] * sensor["focus"] / (sensor["focus"] - sensor["focal"])
    view = 2 * np.degrees(np.arctan(sensor["pitch"] * width / 2 / image_distance))
    to_world = mi.ScalarTransform4f().look_at
    moved = lambda place: [float(a + b) for a, b in zip(place, at)]
    return mi.load_dict({
        "type": "scene",
        "part": {"type": "ply", "filename": ply, "face_normals": True,
                 "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.5}}},
        "laser": {"type": "projector", "to_world": to_world(moved([0, 0, laser["stand_off"]]), moved([0, 0, 0]), [0, 1, 0]),
                  "fov": laser["fan"], "fov_axis": "x",
                  "irradiance": {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True}},
        "sensor": {"type": "perspective", "fov": float(view), "fov_axis": "x",
                   "to_world": to_world(moved(sensor["position"]), moved(sensor["target"]), [0, 0, 1]),
                   "film": {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance",
                            "rfilter": {"type": "box"}, "component_format": "float32"},
                   "sampler": {"type": "independent", "sample_count": 4}},
        "integrator": {"type": "direct", "hide_emitters": True},
    })
