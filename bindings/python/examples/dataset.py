"""A small data set: frames of randomised sensors, each with its truth, and a picture of all.

python examples/dataset.py FOLDER [SENSORS]

Writes sample-KKK.npz (image, depth, points, the sensor's values) and overview.png: above
what each sensor sees, below the depth that is true there. Needs Pillow for the picture.
"""

import json
import sys
from pathlib import Path

import numpy as np
from lasertrace import Flag, Scene, Simulation
from PIL import Image

SCENE = Path(__file__).resolve().parents[3] / "scenes/bracket/scene.toml"


def random_sensor(rng):
    """Values that a sensor of this kind may have, by the keys of the scene."""
    return {
        "seed": int(rng.integers(2**31)),
        "camera.f_number": rng.uniform(5.6, 16),
        "camera.exposure_ms": rng.uniform(0.03, 0.12),
        "camera.read_noise_e": rng.uniform(5, 30),
        "laser.waist_radius_um": rng.uniform(60, 160),
        "part.reflectance": rng.uniform(0.2, 0.8),
        "part.rotation_deg": rng.uniform(-4, 4, 3),
        "part.position_mm": rng.uniform(-2, 2, 3),
    }


def picture(frame):
    """The image and, below it, the depth where the part is, light where near."""
    image = frame.image.astype(float)
    image = np.sqrt(np.clip(image / max(np.percentile(image, 99.9), 1), 0, 1))
    seen = np.isfinite(frame.depth)
    depth = np.zeros(seen.shape)
    if seen.any():
        near, far = frame.depth[seen].min(), frame.depth[seen].max()
        depth[seen] = 1 - 0.8 * (frame.depth[seen] - near) / max(far - near, 1e-6)
    both = np.concatenate([image, depth])
    return (255 * both[::2, ::2]).astype(np.uint8)


def main():
    folder = Path(sys.argv[1])
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 8
    folder.mkdir(parents=True, exist_ok=True)
    scene, rng = Scene.load(SCENE), np.random.default_rng(1)
    pictures = []
    for k in range(count):
        values = random_sensor(rng)
        simulation = Simulation(scene.with_values(values))
        frame = simulation.frame(int(rng.integers(len(simulation))))
        np.savez_compressed(
            folder / f"sample-{k:03}.npz",
            image=frame.image,
            depth=frame.depth,
            points=frame.points,
            part_from_camera=frame.part_from_camera,
            values=json.dumps(values, default=lambda array: array.tolist()),
        )
        pictures.append(picture(frame))
        doubtful = np.count_nonzero(frame.points["flags"] & ~np.uint32(Flag.UNCERTAINTY_NOT_VALID))
        print(f"{k}: frame {frame.number}, {len(frame.points)} points, {doubtful} doubtful")
    rows = [np.concatenate(pictures[i : i + 4], axis=1) for i in range(0, len(pictures), 4)]
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 8), (0, width - row.shape[1]))) for row in rows]
    Image.fromarray(np.concatenate(rows)).save(folder / "overview.png")
    print(folder / "overview.png")


if __name__ == "__main__":
    main()
