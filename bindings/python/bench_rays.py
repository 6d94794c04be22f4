"""Ray casting beside the peers a user would take, on the same rays in one run.

python bench_rays.py [RAYS]

Peers in pure Rust are those of the program LASERTRACE_PEERS (benches/peers/main.rs), without it skipped.

Prints a table (Markdown): Mrays/s on one thread and on all; rays at vertices and middles of
edges of a closed mesh, from outside and inside, that a library loses; and hits that are off after the mesh and its rays
are moved by 10⁴ of its size. Laps of the libraries alternate, and the best of each counts.
A peer that is not installed is skipped with a word. For one thread the program runs itself
again, bound to one core.
"""

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time

import numpy as np

LAPS = 5


def sphere(count):
    """A closed mesh of radius 1 about the origin, and what is at its corners and edges."""
    polar, around = np.meshgrid(
        np.linspace(0, np.pi, count), np.linspace(0, 2 * np.pi, 2 * count, endpoint=False), indexing="ij"
    )
    ring = np.stack(
        [np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1
    )
    places = ring[1:-1].reshape(-1, 3)
    vertices = np.concatenate([[[0.0, 0, 1]], places, [[0.0, 0, -1]]])
    columns = 2 * count
    corner = 1 + np.arange((count - 2) * columns).reshape(count - 2, columns)
    a, b = corner[:-1], corner[1:]
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    north, south = corner[0], corner[-1]
    triangles = [
        np.stack([a, b, c], -1).reshape(-1, 3),
        np.stack([a, c, d], -1).reshape(-1, 3),
        np.stack([np.zeros(columns, int), north, np.roll(north, -1)], -1),
        np.stack([np.full(columns, len(vertices) - 1), np.roll(south, -1), south], -1),
    ]
    return vertices, np.concatenate(triangles)


def at_vertices_and_edges(vertices, triangles, eye):
    """Rays from `eye` at each corner and middle of an edge that it sees well, to meet it at 1."""
    corners = vertices[triangles]
    middles = (corners + np.roll(corners, 1, axis=1)) / 2
    targets = np.concatenate([corners.reshape(-1, 3), middles.reshape(-1, 3)])
    directions = targets - eye
    inside = np.linalg.norm(eye) < 1
    seen = inside | ((targets * directions).sum(axis=1) < -0.1)
    return np.concatenate([np.tile(eye, (seen.sum(), 1)), directions[seen]], axis=1)


INSIDE, UNCERTAINTY_NOT_VALID = np.array([0.1, 0.1, 0.1]), np.array([3.0, 1.0, 2.0])


def random_rays(count):
    """From a sphere around the mesh, no two alike, half of them past it."""
    rng = np.random.default_rng(1)
    rays = np.concatenate([rng.normal(size=(count, 3)), np.zeros((count, 3))], axis=1)
    rays[:, :3] *= 3 / np.linalg.norm(rays[:, :3], axis=1, keepdims=True)
    rays[:, 3:] = rng.uniform(-1, 1, (count, 3)) * 1.2 - rays[:, :3]
    return rays


def camera_rays(count):
    """Those of a square picture's pixels, row by row."""
    side = np.linspace(-0.4, 0.4, round(count**0.5))
    x, y = np.meshgrid(side, side)
    rays = np.zeros((x.size, 6))
    rays[:, 2], rays[:, 3], rays[:, 4], rays[:, 5] = 3, x.ravel(), y.ravel(), -1
    return rays


def ours(backend):
    import lasertrace

    def build(vertices, triangles):
        caster = lasertrace.RayCaster(vertices, triangles, backend=backend)

        def cast(rays):
            hits = caster.cast(rays)
            return hits["distance"], hits["triangle"] != lasertrace.MISS

        return cast

    return build


def open3d(vertices, triangles):
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    mesh = open3d.core.Tensor(vertices.astype(np.float32)), open3d.core.Tensor(triangles.astype(np.uint32))
    scene.add_triangles(*mesh)

    def cast(rays):
        hits = scene.cast_rays(open3d.core.Tensor(rays.astype(np.float32)))
        distance = hits["t_hit"].numpy()
        return distance, np.isfinite(distance)

    return cast


def trimesh(vertices, triangles):
    import trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    intersector = RayMeshIntersector(mesh)

    def cast(rays):
        places, ray, _ = intersector.intersects_location(
            rays[:, :3], rays[:, 3:], multiple_hits=False
        )
        distance = np.full(len(rays), np.inf)
        length = np.linalg.norm(rays[ray, 3:], axis=1)
        distance[ray] = np.linalg.norm(places - rays[ray, :3], axis=1) / length
        return distance, np.isfinite(distance)

    return cast


class Rust:
    """Peers in pure Rust on one mesh, in a program of their own: `names`, and casts by each. Their rays
    are float32 with directions of length 1 before the clock starts."""

    def __init__(self, vertices, triangles):
        self.folder = tempfile.TemporaryDirectory()
        self.write("vertices", vertices, "<f8")
        self.write("triangles", triangles, "<u4")
        command = [os.environ["LASERTRACE_PEERS"], self.folder.name]
        self.program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.names = list(iter(lambda: self.program.stdout.readline().strip(), ""))

    def write(self, name, array, kind):
        array.astype(kind).tofile(os.path.join(self.folder.name, name))

    def cast(self, name, rays, kind):
        """Distances, whether anything was met, and seconds."""
        if not os.path.exists(os.path.join(self.folder.name, kind)):
            self.write(kind, rays, "<f8")
        print(name, kind, file=self.program.stdin, flush=True)
        seconds = float(self.program.stdout.readline())
        distance = np.fromfile(os.path.join(self.folder.name, "distances"), "<f4").astype(float)
        return distance, np.isfinite(distance), seconds


PEERS = {
    "lasertrace, Embree": (ours("embree"), "lasertrace"),
    "lasertrace, Rust": (ours("rust"), "lasertrace"),
    "Open3D RaycastingScene": (open3d, "open3d"),
    "trimesh + embreex": (trimesh, "embreex"),
}


def timed(cast):
    """`cast`, which then also gives its seconds."""

    def timed_cast(rays, _):
        start = time.perf_counter()
        answer = cast(rays)
        return *answer, time.perf_counter() - start

    return timed_cast


def build_all(vertices, triangles):
    """Casts by name, each of rays and the name of their kind."""
    casts = {}
    for name, (build, module) in PEERS.items():
        try:
            importlib.import_module(module)
        except ImportError:
            print(f"SKIPPED: {name}: {module} is not installed", file=sys.stderr)
            continue
        casts[name] = timed(build(vertices, triangles))
    if "LASERTRACE_PEERS" in os.environ:
        rust = Rust(vertices, triangles)
        for name in rust.names:
            casts[name] = lambda rays, kind, name=name: rust.cast(name, rays, kind)
    else:
        print("SKIPPED: peers in Rust: bench.sh starts them", file=sys.stderr)
    return casts


def measure(count):
    vertices, triangles = sphere(300)
    sets = {"camera": camera_rays(count), "random": random_rays(count)}
    aimed = {
        place: at_vertices_and_edges(vertices, triangles, eye)
        for place, eye in [("outside", UNCERTAINTY_NOT_VALID), ("inside", INSIDE)]
    }
    # A mesh of radius 1 within 10⁴ of its diameters from the origin.
    away = np.array([2e4, 0, 0])
    moved = sets["random"].copy()
    moved[:, :3] += away

    casts = build_all(vertices, triangles)
    casts_away = build_all(vertices + away, triangles)
    # What is right: our own tree in float64, on the moved numbers.
    right, right_met = ours("rust")(vertices + away, triangles)(moved)
    best = {(name, kind): np.inf for name in casts for kind in sets}
    for _ in range(LAPS):
        for name, kind in best:
            seconds = casts[name](sets[kind], kind)[2]
            best[name, kind] = min(best[name, kind], seconds)
    table = {}
    for name, cast in casts.items():
        lost, off = {}, {}
        for place, at in aimed.items():
            distance, met, _ = cast(at, place)
            lost[place] = f"{(~met).sum()} of {len(at)}"
            off[place] = int((met & ~(np.abs(distance - 1) < 1e-6)).sum())
        far, far_met, _ = casts_away[name](moved, "moved")
        with np.errstate(invalid="ignore"):
            apart = np.abs(far - right) * np.linalg.norm(moved[:, 3:], axis=1) > 1e-6
        wrong = (far_met != right_met) | (far_met & right_met & apart)
        table[name] = {
            "speed": {kind: len(rays) / best[name, kind] / 1e6 for kind, rays in sets.items()},
            "lost": lost,
            "off": off,
            "wrong": float(wrong.mean()),
        }
    return table


def main():
    if sys.argv[1:2] == ["--table"]:
        print(json.dumps(measure(int(sys.argv[2]))))
        return
    count = sys.argv[1] if len(sys.argv) > 1 else "1000000"
    first = [min(os.sched_getaffinity(0))]
    command = [sys.executable, __file__, "--table", count]
    one, all_ = (
        json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True, preexec_fn=bind).stdout)
        for bind in [lambda: os.sched_setaffinity(0, first), None]
    )
    threads = len(os.sched_getaffinity(0))
    print(
        f"| | Mrays/s of a camera, 1 thread | {threads} threads | random, 1 thread | {threads} threads "
        "| lost at vertices and edges, from outside | from inside | off by 1e-6 there | wrong by "
        "1e-6 after 10⁴ sizes |"
    )
    print("|---" * 9 + "|")
    for name, row in all_.items():
        speeds = [run[name]["speed"][kind] for kind in ["camera", "random"] for run in [one, all_]]
        speeds = " | ".join(f"{speed:.2f}" for speed in speeds)
        print(
            f"| {name} | {speeds} | {row['lost']['outside']} | "
            f"{row['lost']['inside']} | {sum(row['off'].values())} | {100 * row['wrong']:.2f} % |"
        )


if __name__ == "__main__":
    main()
