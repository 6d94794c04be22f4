"""Laps of Python's, which benches/through_python.rs holds against the core's.

python bench_laps.py FOLDER SCENE FIRST COUNT THREADS

FOLDER holds vertices, triangles and rays as bare numbers. For each line on stdin ("cast",
"into" an array that is there, or "frames") the program prints the seconds that took; at the
end it writes hits and images to FOLDER.
"""

import sys
import time
from pathlib import Path

import numpy as np

from lasertrace import RayCaster, Scene, Simulation

folder, scene = Path(sys.argv[1]), sys.argv[2]
first, count, threads = map(int, sys.argv[3:])
vertices = np.fromfile(folder / "vertices").reshape(-1, 3)
triangles = np.fromfile(folder / "triangles", np.uint32).reshape(-1, 3)
rays = np.fromfile(folder / "rays").reshape(-1, 6)
caster = RayCaster(vertices, triangles, threads=threads)
simulation = Simulation(Scene.load(scene), threads=threads)
hits = caster.cast(rays)
images = []
print("ready", flush=True)
for line in sys.stdin:
    start = time.perf_counter()
    if line == "cast\n":
        given = caster.cast(rays)
    elif line == "into\n":
        caster.cast(rays, out=hits)
    else:
        images = [frame.image for frame in simulation.frames(range(first, first + count))]
    print(time.perf_counter() - start, flush=True)
    given = None
hits.tofile(folder / "hits")
np.concatenate(images).tofile(folder / "images")
