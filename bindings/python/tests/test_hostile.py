"""Hostile calls: an error each, which says what was found; never a crash. The rows are those
of the table in README.md, which a test holds against this file."""

import threading
import unittest
from pathlib import Path

import numpy as np
from lasertrace import Error, RayCaster, Scene, Simulation, engine

ROOT = Path(__file__).resolve().parents[3]
PLANE = ROOT / "scenes/plane/scene.toml"
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])

itself = {"seed": 1}
itself["part"] = itself


def rays(value):
    """Five rays that meet the square, one number of the fourth replaced."""
    made = np.tile([0.75, 0.25, 2, 0, 0, -1.0], (5, 1))
    made[3, 4] = value
    return made


def cast(given, **options):
    return RayCaster(SQUARE, HALVES).cast(given, **options)


def build(vertices=SQUARE, triangles=HALVES, **options):
    return RayCaster(vertices, triangles, **options)


def change(values):
    return Scene.load(PLANE).with_values(values)


def simulation():
    return Simulation(Scene.load(PLANE))


def from_two_threads():
    """Frames that are asked for by one thread while another takes them."""
    frames = simulation().frames()

    def within(done, total):
        pass

    errors, start = [], threading.Barrier(2)

    def work():
        start.wait()
        try:
            for _ in frames:
                pass
        except Error as error:
            errors.append(error)

    for _ in range(200):
        frames = simulation_shared.frames()
        workers = [threading.Thread(target=work) for _ in range(2)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        if errors:
            raise errors[0]


def into(change):
    """Rays cast into an array that was made for them and then changed."""
    caster = RayCaster(SQUARE, HALVES)
    return caster.cast(rays(0), out=change(caster.cast(rays(0))))


def frozen(hits):
    hits.flags.writeable = False
    return hits


def from_hits():
    """Rays read from the memory that hits are to be written to."""
    hits = RayCaster(SQUARE, HALVES).cast(rays(0))
    same = hits.view("f8")[:30].reshape(5, 6)
    same[:] = rays(0)
    return cast(same, out=hits)


def into_one_from_two_threads():
    caster, many = RayCaster(SQUARE, HALVES), np.tile(rays(0), (100_000, 1))
    hits, errors = caster.cast(many), []

    def work():
        try:
            for _ in range(100):
                caster.cast(many, out=hits)
        except Error as error:
            errors.append(error)

    workers = [threading.Thread(target=work) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    if errors:
        raise errors[0]


huge = np.broadcast_to(np.zeros(6), (10**15, 6))
unlike = np.eye(4)[None] * 2
sheared = np.eye(4)[None].copy()
sheared[0, 3, 0] = 1

# What is called, how, and what its message says.
CALLS = [
    ("rays as a list", lambda: cast([[0, 0, 2, 0, 0, -1]]), "rays: found a .*list.*NumPy array of float32 or float64"),
    ("rays of whole numbers", lambda: cast(np.ones((5, 6), int)), "rays: found an array of int64"),
    ("rays of the other byte order", lambda: cast(rays(0).astype(">f8")), "rays: found an array of >f8"),
    ("rays of objects", lambda: cast(rays(0).astype(object)), "rays: found an array of object"),
    ("rays with five numbers", lambda: cast(np.ones((5, 5))), r"shape \[5, 5\], expected .*\(\.\.\., 6\)"),
    ("rays without axes", lambda: cast(np.float64(1)), "rays: found"),
    ("a ray with NaN", lambda: cast(rays(np.nan)), "ray 3: direction"),
    ("a ray with infinity", lambda: cast(rays(np.inf)), "ray 3: direction"),
    ("a ray without direction", lambda: cast(np.zeros((1, 6))), "ray 0: direction"),
    ("t_max NaN", lambda: cast(rays(0), t_max=np.nan), "ray 0: t_max NaN"),
    ("t_max negative", lambda: cast(rays(0), t_max=-1), "ray 0: t_max -1"),
    ("10¹⁵ rays that are one", lambda: cast(huge), "memory|allocate"),
    ("an out of another shape", lambda: into(lambda hits: hits[:4]), r"out: found .* and shape \[4\], expected .* for shape \[5\]"),
    ("an out of another type", lambda: into(lambda hits: np.zeros(5)), "out: found an array of float64"),
    ("an out that is no array", lambda: into(list), "out: found a .*list"),
    ("an out with gaps", lambda: into(lambda hits: np.repeat(hits, 2)[::2]), "writable, without gaps"),
    ("an out that is read-only", lambda: into(frozen), "writable, without gaps"),
    ("an out across the words of memory", lambda: into(lambda hits: np.zeros(284, "u1")[1:281].view(hits.dtype)), "writable, without gaps"),
    ("an out that is the rays", from_hits, "out: found an array in use"),
    ("one out for two threads", into_one_from_two_threads, "out: found an array in use"),
    ("a point with NaN", lambda: build().nearest(np.full((2, 3), np.nan)), "point 0"),
    ("a vertex with NaN", lambda: build(vertices=SQUARE * np.nan), "vertex 0"),
    ("a vertex beyond 10¹² mm", lambda: build(vertices=SQUARE * 1e13), "vertex 1"),
    ("no triangles", lambda: build(triangles=HALVES[:0]), "0 triangles, expected 1"),
    ("a vertex number too high", lambda: build(triangles=HALVES + 2), "triangle 0 uses vertex 4"),
    ("a vertex number below 0", lambda: build(triangles=HALVES - 1), "triangle 0 uses vertex -1"),
    ("triangles of floats", lambda: build(triangles=HALVES * 1.0), "triangles: found an array of float64"),
    ("triangles of four corners", lambda: build(triangles=np.zeros((2, 4), int)), r"shape \[2, 4\]"),
    ("an instance with scale", lambda: build(instances=unlike), "instance 0: found"),
    ("an instance that is no pose", lambda: build(instances=sheared), "instance 0: found .* as last row"),
    ("instances of another shape", lambda: build(instances=np.eye(4)), r"\(n, 4, 4\)"),
    ("no instance", lambda: build(instances=np.zeros((0, 4, 4))), "0 instances, expected 1"),
    ("an unknown backend", lambda: build(backend="optix"), '"optix", expected "embree" or "rust"'),
    ("an unknown engine", lambda: engine("optix"), '"optix", expected "embree" or "rust"'),
    ("no threads", lambda: build(threads=0), "threads: found 0"),
    ("-1 threads", lambda: Simulation(Scene.load(PLANE), threads=-1), "threads: found -1"),
    ("all hits of a ray with NaN", lambda: build().all_hits(rays(np.nan)), "ray 3: direction"),
    ("all hits of 10¹⁵ rays", lambda: build().all_hits(huge), "memory|allocate|direction"),
    ("hits counted with t_max NaN", lambda: build().count_hits(rays(0), t_max=np.nan), "ray 0: t_max NaN"),
    ("inside of an open mesh", lambda: build().contains_points(SQUARE), "the mesh is open: found 4 edges"),
    ("signed distance to an open mesh", lambda: build().signed_distance(SQUARE), "the mesh is open"),
    ("thickness of an open mesh", lambda: build().thickness(rays(0)), "the mesh is open"),
    ("winding number around infinity", lambda: build().winding_number(SQUARE + np.inf), "point 0"),
    ("a batch of 0 rays", lambda: build().cast_batches(rays(0), batch=0), "batch: found 0"),
    ("batches of another shape", lambda: build().cast_batches(rays(0)[0]), r"rays: found shape \(6,\)"),
    ("a batch with NaN", lambda: list(build().cast_batches(iter([rays(0), rays(np.nan)]))), "ray 3: direction"),
    ("origins without directions", lambda: build().intersects_first(SQUARE, SQUARE[:2]), "ray_directions: found 2, expected 4"),
    ("origins of another shape", lambda: build().intersects_any([1, 2], SQUARE), "ray_origins: found list"),
    ("frame -1", lambda: simulation().frame(-1), "frame -1: expected a whole number from 0 to 8"),
    ("a frame behind the last", lambda: simulation().frame(9), "frame 9: expected"),
    ("frame 1.5", lambda: simulation().frame(1.5), "frame 1.5: expected"),
    ("frame 10³⁰", lambda: simulation().frame(10**30), "frame 1000.*: expected"),
    ("10¹⁸ frames", lambda: simulation().frames(range(10**18)), "frame 9+: expected"),
    ("more frames than a machine counts", lambda: simulation().frames(range(10**30)), "frames: found range"),
    ("frames of a generator", lambda: simulation().frames(k for k in [1]), "frames: found <generator"),
    ("frames from two threads at once", from_two_threads, "another thread is taking these frames"),
    ("a file that is not there", lambda: Scene.load("/nowhere/scene.toml"), "cannot read /nowhere/scene.toml"),
    ("a folder", lambda: Scene.load(ROOT), "a folder, expected a scene file"),
    ("a text that is no TOML", lambda: Scene.parse("seed = = 1"), "scene text:1: .*not TOML"),
    ("an empty dict", lambda: Scene.from_dict({}), "seed is missing"),
    ("a dict with NaN", lambda: change({"camera.f_number": np.nan}), "camera.f_number: found nan"),
    ("a dict with a set", lambda: change({"camera.f_number": {4}}), "camera.f_number: found a value of type set"),
    ("a dict that holds itself", lambda: Scene.from_dict(itself), "more than 16 deep"),
    ("a dict with a key that is no text", lambda: change({1: 2}), "a key: found a .*int.*expected text"),
    ("a number beyond 64 bits", lambda: change({"seed": 2**64}), "seed: found an int beyond"),
    ("an unknown key", lambda: change({"camera.f_numbre": 4}), "did you mean f_number"),
    ("an unknown key taken out", lambda: change({"camera.f_numbre": None}), "the scene does not have it"),
    ("a key in a number", lambda: change({"camera.f_number.x": 4}), "camera.f_number.x: f_number is a value"),
    ("a place behind a list", lambda: change({"camera.resolution_px.2": 4}), "a whole number below 2"),
    ("a camera of 10⁹ columns", lambda: change({"camera.resolution_px.0": 10**9}), "camera.resolution_px"),
]  # fmt: skip

simulation_shared = simulation()


class Hostile(unittest.TestCase):
    def test_each_call_is_an_error_that_says_what_was_found(self):
        for name, call, message in CALLS:
            with self.subTest(name):
                with self.assertRaisesRegex((Error, MemoryError), message):
                    call()

    def test_the_table_has_these_rows(self):
        readme = (Path(__file__).parents[1] / "README.md").read_text()
        table = readme.split("| hostile call |")[1].split("\n\n")[0]
        rows = [line.split("|")[1].strip() for line in table.splitlines()[2:]]
        self.assertEqual(rows, [name for name, _, _ in CALLS])

    def test_a_wrong_type_is_an_error_of_python(self):
        for call in [
            lambda: Simulation("scene.toml"),
            lambda: Scene.parse(1),
            lambda: Scene.from_dict([1]),
            lambda: cast(rays(0), t_max="far"),
            lambda: build().all_hits(rays(0), limit="many"),
            lambda: build().cast_batches(),
            lambda: RayCaster(SQUARE),
            lambda: Simulation(),
        ]:
            with self.assertRaises(TypeError):
                call()


if __name__ == "__main__":
    unittest.main()
