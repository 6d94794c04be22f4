"""Casts a million rays at a mesh and says how many met it.

python examples/cast_rays.py [RAYS]
"""

import sys
import time

import numpy as np
from lasertrace import MISS, RayCaster


def wavy_ground(count):
    """A square of `count`² cells, 100 mm wide, with waves of 2 mm."""
    side = np.linspace(-50, 50, count + 1)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x, y, 2 * np.sin(x / 5) * np.cos(y / 7)], axis=-1).reshape(-1, 3)
    corner = np.arange(len(vertices)).reshape(x.shape)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    halves = [np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]
    return vertices, np.stack(halves).reshape(-1, 3)


def main():
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    vertices, triangles = wavy_ground(300)
    caster = RayCaster(vertices, triangles)

    # From 100 mm above, down into all directions within 45°.
    rng = np.random.default_rng(1)
    rays = np.empty((count, 6))
    rays[:, :3] = [0, 0, 100]
    rays[:, 3:5] = rng.uniform(-1, 1, (count, 2))
    rays[:, 5] = -1

    start = time.perf_counter()
    hits = caster.cast(rays)
    seconds = time.perf_counter() - start

    met = hits["triangle"] != MISS
    print(f"{caster}: {count} rays in {seconds:.3f} s, {met.sum()} met it")
    # What was met lies on the ray, and between the waves' crests.
    point = hits["point"][met]
    along = rays[met, :3] + rays[met, 3:] * hits["distance"][met, None]
    assert np.abs(point - along).max() < 1e-9, "mm"
    assert np.abs(point[:, 2]).max() <= 2
    # The ground covers a quarter of what the rays look at, (50/100)², but for its waves' ±2 mm,
    # which move its border by 2 %, and for the chance of a count: five of its standard
    # deviations.
    assert abs(met.mean() - 0.25) < 0.25 * 0.04 + 5 * np.sqrt(0.25 * 0.75 / count)


if __name__ == "__main__":
    main()
