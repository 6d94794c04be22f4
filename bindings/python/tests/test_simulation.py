"""Scenes and frames: the bytes of the command line, values by key, threads, interruption."""

import copy
import csv
import json
import os
import pickle
import random
import signal
import subprocess
import sys
import tempfile
import threading
import unittest
from pathlib import Path

import numpy as np
from lasertrace import _core
from lasertrace import MISS, Error, Flag, RayCaster, Scene, Simulation

ROOT = Path(__file__).resolve().parents[3]
PLANE = ROOT / "scenes/plane/scene.toml"
BRACKET = ROOT / "scenes/bracket/scene.toml"

# The plane's scene as Python has it.
VALUES = {
    "seed": 1,
    "speckle": False,
    "part": {"plane": {"size_mm": np.array([20, 20])}, "reflectance": 0.5, "rotation_deg": (8, 5, 0)},
    "laser": {
        "wavelength_nm": 660,
        "power_mw": 5,
        "waist_radius_um": 30,
        "waist_distance_mm": 150,
        "position_mm": [0, 0, 150],
        "direction": [0, 0, -1],
        "line": {"fan_deg": 5, "profile": "uniform", "direction": [1, 0, 0]},
    },
}


class Scenes(unittest.TestCase):
    def test_file_text_and_dict_are_one_scene(self):
        text = PLANE.read_text()
        loaded, parsed = Scene.load(PLANE), Scene.parse(text, PLANE.parent)
        tables = {}
        # Python 3.11 reads TOML; for older ones the table is written out in part.
        try:
            import tomllib

            tables = tomllib.loads(text)
        except ImportError:
            tables = None
        scenes = [loaded, parsed]
        if tables is not None:
            self.assertEqual({k: tables["laser"][k] for k in VALUES["laser"]}, VALUES["laser"])
            scenes.append(Scene.from_dict({**tables, **VALUES, "plan": None}))
        images = [Simulation(scene).frame(4).image for scene in scenes]
        for image in images:
            np.testing.assert_array_equal(image, images[0])
        self.assertEqual((loaded.frames, loaded.resolution), (9, (640, 300)))
        self.assertEqual(loaded.text, text)

    def test_scenes_and_simulations_pass_to_other_processes(self):
        for path, values in [
            (PLANE, {}),
            (PLANE, {"seed": 7, "camera.f_number": 11}),
            (BRACKET, {"part.rotation_deg": [0, 0, 3]}),
        ]:
            scene = Scene.load(path).with_values(values)
            simulation = Simulation(scene, threads=1)
            again = pickle.loads(pickle.dumps(simulation))
            self.assertEqual((again.scene.text, again.scene.frames), (scene.text, scene.frames))
            np.testing.assert_array_equal(again.frame(2).image, simulation.frame(2).image)
            self.assertEqual(copy.deepcopy(scene).text, scene.text)
            # Another process, in another working folder, as loaders of data start them.
            code = "import pickle, sys; print(pickle.load(sys.stdin.buffer).frame(2).image.sum())"
            with tempfile.TemporaryDirectory() as folder:
                found = subprocess.run(
                    [sys.executable, "-c", code], input=pickle.dumps(simulation), cwd=folder, capture_output=True,
                )
            self.assertEqual(found.stderr, b"")
            self.assertEqual(int(found.stdout), simulation.frame(2).image.sum())

    def test_cameras_are_scenes(self):
        text = PLANE.read_text()
        start, end = text.index("[camera]"), text.index("[scan]")
        camera = text[start:end].replace("[camera]", "[[camera]]")
        scene = Scene.parse(text[:start] + camera + camera + "read_noise_e = 10\n" + text[end:], PLANE.parent)
        with self.assertRaisesRegex(Error, "found 2 cameras, expected one"):
            Simulation(scene)
        first, second = scene.cameras
        self.assertIn("number = 2", second.text)
        again = pickle.loads(pickle.dumps(second))
        image = Simulation(second).frame(0).image
        self.assertTrue(np.array_equal(image, Simulation(again).frame(0).image))
        self.assertFalse(np.array_equal(image, Simulation(first).frame(0).image))
        (alone,) = Scene.load(PLANE).cameras
        self.assertEqual(alone.text, Scene.load(PLANE).text)

    def test_values_change_by_key_and_the_scene_stays(self):
        scene = Scene.load(BRACKET)
        # 1/N² of the light: half the f-number, four times as much, up to the counts' end.
        # A sharp image: the lens's blur changes with the f-number, too.
        dark = {"speckle": False, "camera.read_noise_e": None, "camera.black_level_dn": None, "model.defocus_model": "none"}
        narrow = scene.with_values({**dark, "camera.f_number": 32})
        wide = narrow.with_values({"camera.f_number": np.float32(16)})
        mean = [Simulation(s).frame(100).image.astype(float).max() for s in (narrow, wide)]
        # Counts are rounded to whole ones, both by half of one at most.
        self.assertGreater(mean[0], 10)
        self.assertLess(abs(mean[1] - 4 * mean[0]), 0.5 + 4 * 0.5)
        self.assertIn("f_number = 8", scene.text)

        moved = scene.with_values({"camera.resolution_px.1": 256, "part.position_mm": [0, 0, 1]})
        self.assertEqual(moved.resolution, (1280, 256))
        sphere = {"part.mesh": None, "part.sphere": {"radius_mm": 5.0, "chordal_deviation_um": 10}}
        self.assertIn("sphere", repr(scene.with_values(sphere)))

    def test_an_unknown_key_is_an_error_that_helps(self):
        scene = Scene.load(PLANE)
        with self.assertRaisesRegex(Error, r"camera\.f_numbre.*did you mean f_number\?"):
            scene.with_values({"camera.f_numbre": 4})
        with self.assertRaisesRegex(ValueError, r"camera\.f_number: found 0"):
            scene.with_values({"camera.f_number": 0})


def png(path):
    from PIL import Image

    with Image.open(path) as image:
        return np.array(image).astype(np.uint16)


class Frames(unittest.TestCase):
    @unittest.skipUnless(os.environ.get("LASERTRACE"), "LASERTRACE names no program")
    def test_a_frame_is_that_of_the_command_line(self):
        for path, number in [(PLANE, 4), (BRACKET, 90)]:
            with tempfile.TemporaryDirectory() as folder:
                program = [os.environ["LASERTRACE"], "render", path, "--frame", str(number)]
                subprocess.run([*program, "-o", folder, "--quiet"], check=True, stdout=subprocess.DEVNULL)
                expected = png(Path(folder, f"frame-{number:06}.png"))
            frame = Simulation(Scene.load(path)).frame(number)
            self.assertEqual(frame.image.dtype, np.uint16)
            self.assertEqual(frame.image.tobytes(), expected.tobytes())

    @unittest.skipUnless(os.environ.get("LASERTRACE"), "LASERTRACE names no program")
    def test_points_are_those_of_the_command_line(self):
        """Flags, repeatability and correlation lengths of random scenes are byte-identical."""
        names = ["repeatability", "correlation_length", "scan_correlation_length"]

        def scanned(path, first, end):
            with tempfile.TemporaryDirectory() as folder:
                program = [os.environ["LASERTRACE"], "scan", path, "--frames", f"{first}..{end}"]
                subprocess.run([*program, "-o", folder, "--quiet"], check=True, stdout=subprocess.DEVNULL)
                return np.load(Path(folder, "profiles.npy"))

        def assert_same(points, expected):
            self.assertGreater(len(points), 0)
            for name in names:
                self.assertEqual(points[name].tobytes(), expected[f"{name}_mm"].tobytes())
            for name in ["frame", "column"]:
                self.assertEqual(points[name].tobytes(), expected[name].tobytes())
            self.assertEqual(points["flags"].astype("u2").tobytes(), expected["flags"].tobytes())

        for seed in range(3):
            draw = random.Random(seed)
            radius = draw.uniform(2, 4)
            step = {"size_mm": [20, 20, 10], "step_mm": draw.uniform(0.3, 0.9)}
            part = [
                {"part.sphere": {"radius_mm": radius, "chordal_deviation_um": 2}, "part.position_mm": [0, 0, -radius]},
                {"part.step_block": step, "part.position_mm": [0, 0, -9.5]},
            ][seed % 2]
            values = {
                "seed": seed,
                "speckle": True,
                "part.plane": None,
                "part.rotation_deg": [draw.uniform(-8, 8), 0, draw.uniform(-40, 40)],
                "camera.read_noise_e": 8,
                "camera.resolution_px": [320, 200],
                **part,
                # Filters apply to complete profiles.
                **({"measure.average_frames": 3, "measure.median_filter_columns": 3} if seed == 2 else {}),
            }
            simulation = Simulation(Scene.load(PLANE).with_values(values))
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, "scene.toml")
                path.write_text(simulation.scene.text)
                assert_same(simulation.points(), scanned(path, 0, 9))
                assert_same(simulation.points(3, 6), scanned(path, 3, 6))
                if seed < 2:
                    for frame in list(simulation.frames(range(2, 7, 2)))[1:2]:
                        assert_same(frame.points, scanned(path, frame.number, frame.number + 1))
        for start, stop, words in [(9, None, "frame 9"), (4, 4, "from 5 to 9"), (0, 10, "from 1 to 9")]:
            with self.assertRaisesRegex(Error, words):
                Simulation(Scene.load(PLANE)).points(start, stop)

    @unittest.skipUnless(os.environ.get("LASERTRACE"), "LASERTRACE names no program")
    def test_features_are_those_of_the_command_line(self):
        """Values and verdicts of random scenes equal features.csv and summary.json."""
        for seed in range(3):
            draw = random.Random(seed)
            step = draw.uniform(0.3, 0.9)
            planes = [
                {"name": "high", "kind": "plane", "point_mm": [4, 0, 10], "form": True},
                {"name": "low, \"wide\"", "kind": "plane", "point_mm": [-4, 0, 10 - step]},
                {"name": "hidden", "kind": "plane", "point_mm": [1, 2, 0]},
            ]
            limits = {"height_mm": [-0.02, draw.uniform(0.001, 0.05)]}
            height = {"kind": "step-height", "between": ["low, \"wide\"", "high"], "tolerance": limits}
            values = {
                "seed": seed,
                "speckle": True,
                "part.plane": None,
                "part.step_block": {"size_mm": [20, 20, 10], "step_mm": step},
                "part.position_mm": [0, 0, -9.5],
                "part.rotation_deg": [draw.uniform(-8, 8), 0, draw.uniform(-10, 10)],
                "camera.read_noise_e": 8,
                "camera.resolution_px": [320, 200],
                "measure.best_fit_alignment": seed == 2,
                "feature": [*planes, {"name": "step", **height}],
            }
            simulation = Simulation(Scene.load(PLANE).with_values(values))
            found = simulation.features()
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder, "scene.toml")
                path.write_text(simulation.scene.text)
                program = [os.environ["LASERTRACE"], "scan", path, "-o", Path(folder, "out"), "--quiet"]
                subprocess.run(program, check=True, stdout=subprocess.DEVNULL)
                summary = json.loads(Path(folder, "out", "summary.json").read_text())
                with Path(folder, "out", "features.csv").open(newline="") as file:
                    rows = list(csv.DictReader(file))
            self.assertEqual(found, summary["features"])
            self.assertEqual(sum(feature["problem"] is not None for feature in found), 1)
            of_rows = [row for row in rows if row["quantity"]]
            pairs = [(f, q) for f in found for q in f["quantities"]]
            self.assertEqual(len(of_rows), len(pairs))
            self.assertGreater(len(pairs), 4)
            for row, (feature, quantity) in zip(of_rows, pairs):
                self.assertEqual((row["feature"], row["quantity"]), (feature["name"], quantity["name"]))
                for name in ["nominal", "measured", "deviation", "expanded_uncertainty", "smallest_tolerance"]:
                    self.assertEqual(float(row[name]), quantity[name])
                self.assertEqual(row["conformance"].replace(" ", "-"), quantity["conformance"] or "")

    def test_frames_are_those_asked_for_on_any_number_of_threads(self):
        scene = Scene.load(PLANE)
        one, all_ = Simulation(scene, threads=1), Simulation(scene)
        self.assertEqual(len(one), 9)
        for numbers in [None, range(2, 8, 3), range(7, 1, -2), [3, 3, 0], np.array([5]), range(0)]:
            expected = list(range(9) if numbers is None else numbers)
            heard = []
            frames = all_.frames(numbers, progress=lambda *call: heard.append(call))
            taken = list(frames)
            self.assertEqual([frame.number for frame in taken], expected)
            self.assertEqual(heard, [(k + 1, len(expected)) for k in range(len(expected))])
            for a, b in zip(taken, one.frames(numbers)):
                self.assertEqual(a.image.tobytes(), b.image.tobytes())
                self.assertEqual(a.points.tobytes(), b.points.tobytes())

    def test_arrays_are_what_they_say(self):
        frame = Simulation(Scene.load(PLANE)).frame(4)
        self.assertEqual(frame.image.shape, (300, 640))
        self.assertTrue(frame.image.flags.writeable and not frame.image.flags.owndata)
        points = frame.points
        self.assertEqual(len(points), 640)
        np.testing.assert_array_equal(points["column"], np.arange(640))
        np.testing.assert_array_equal(points["frame"], 4)
        # The scene has neither noise nor speckle; its README promises 1 µm.
        self.assertLess(np.abs(points["deviation"]).max(), 1e-3)
        # On the plane the deviation is the place's height in the part's frame.
        np.testing.assert_allclose(points["deviation"], points["position"][:, 2], atol=1e-12)
        self.assertTrue(all(np.isfinite(points[name]).all() for name in points.dtype.names))
        # The line lies where the image is bright: within a pixel of its brightest row.
        brightest = frame.image.argmax(axis=0)
        self.assertLess(np.abs(points["row"] - 0.5 - brightest).max(), 1)

    def test_truth_is_what_rays_from_the_camera_meet(self):
        frame = Simulation(Scene.load(PLANE)).frame(4)
        depth, truth = frame.depth, frame.truth
        self.assertIs(frame.truth, truth)
        self.assertEqual((depth.shape, depth.dtype), ((300, 640), np.float32))
        self.assertTrue((np.isfinite(depth) == (truth["triangle"] != MISS)).all())
        seen = np.isfinite(depth)
        self.assertGreater(seen.sum(), 1000)
        # Of the plane; positions are float32 of up to 10 mm.
        eye, axis = frame.part_from_camera[:3, 3], frame.part_from_camera[:3, 2]
        along = (truth["position"][seen] - eye) @ axis
        np.testing.assert_allclose(along, depth[seen], rtol=2**-22)
        square = np.array([[-10.0, -10, 0], [10, -10, 0], [10, 10, 0], [-10, 10, 0]])
        caster = RayCaster(square, np.array([[0, 1, 2], [0, 2, 3]]))
        position = truth["position"][seen].astype(float)
        rays = np.concatenate([np.broadcast_to(eye, position.shape), position - eye], axis=1)
        hits = caster.cast(rays)
        # A place rounded to float32 at the border may lie beside the plane.
        self.assertLess((hits["triangle"] == MISS).mean(), 0.01)
        met = hits["triangle"] != MISS
        np.testing.assert_allclose(hits["distance"][met], 1, atol=1e-6)

    def test_flags_are_those_of_the_simulator(self):
        self.assertEqual(_core.FLAGS, {flag.name: flag.value for flag in Flag})

    def test_python_threads_share_a_simulation(self):
        simulation = Simulation(Scene.load(PLANE))
        expected = [frame.image.tobytes() for frame in simulation.frames()]
        wrong = []

        def work():
            for frame in simulation.frames():
                if frame.image.tobytes() != expected[frame.number]:
                    wrong.append(frame.number)

        workers = [threading.Thread(target=work) for _ in range(4)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        self.assertEqual(wrong, [])

    def test_other_threads_run_while_frames_are_taken(self):
        """A thread that counts gets on between the calls of one long one."""
        simulation = Simulation(Scene.load(BRACKET))
        counted, ended = [0], threading.Event()

        def count():
            while not ended.is_set():
                counted[0] += 1

        counter = threading.Thread(target=count)
        counter.start()
        before = counted[0]
        simulation.frame(90)
        during = counted[0] - before
        ended.set()
        counter.join()
        # With the lock held it would be what fits into a switch of threads, or nothing.
        self.assertGreater(during, 1000)

    def test_what_progress_raises_ends_the_loop(self):
        def stop(done, total):
            if done == 3:
                raise RuntimeError("enough")

        taken = []
        with self.assertRaisesRegex(RuntimeError, "enough"):
            taken.extend(Simulation(Scene.load(PLANE)).frames(progress=stop))

    def test_progress_hears_of_the_building_and_ends_it(self):
        # Some seconds' worth of triangles.
        ball = {"part.plane": None, "part.sphere": {"radius_mm": 10, "chordal_deviation_um": 0.02}}
        scene = Scene.load(PLANE).with_values(ball)
        shares = []
        Simulation(scene, progress=shares.append)
        self.assertEqual(shares, sorted(shares))
        self.assertTrue(shares and all(0 <= share <= 1 for share in shares), shares)

        def stop(share):
            raise RuntimeError("enough")

        with self.assertRaisesRegex(RuntimeError, "enough"):
            Simulation(scene, progress=stop)

    def test_ctrl_c_ends_what_takes_time(self):
        scan = (
            "import lasertrace\n"
            f"s = lasertrace.Simulation(lasertrace.Scene.load({str(BRACKET)!r}))\n"
            "print('started', flush=True)\n"
            "while True:\n"
            "    for frame in s.frames(): pass\n"
        )
        # Far more triangles than can be made ready before.
        build = (
            "import lasertrace\n"
            "ball = {'part.plane': None, 'part.sphere': {'radius_mm': 10, 'chordal_deviation_um': 0.02}}\n"
            f"s = lasertrace.Scene.load({str(PLANE)!r}).with_values(ball)\n"
            "print('started', flush=True)\n"
            "while True:\n"
            "    lasertrace.Simulation(s)\n"
        )
        # Far more rays than can be cast before the signal comes, and no memory for them.
        cast = (
            "import lasertrace, numpy as np\n"
            "c = lasertrace.RayCaster(np.eye(3), np.array([[0, 1, 2]]))\n"
            "print('started', flush=True)\n"
            "while True:\n"
            "    c.any_hit(np.broadcast_to(np.ones(6), (5_000_000, 6)))\n"
        )
        # A shell's background jobs ignore Ctrl-C, and so would Python in one.
        hear = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        for program in [scan, build, cast]:
            run = subprocess.Popen(
                [sys.executable, "-c", hear + program], stdout=subprocess.PIPE, stderr=subprocess.PIPE
            )
            self.assertEqual(run.stdout.readline(), b"started\n")
            run.send_signal(signal.SIGINT)
            _, said = run.communicate(timeout=120)
            self.assertIn(b"KeyboardInterrupt", said)


    def test_what_a_signal_handler_raises_arrives_as_it_is(self):
        class Raised(BaseException):
            pass

        def handler(number, frame):
            raise Raised

        caster = RayCaster(np.eye(3), np.array([[0, 1, 2]]))
        rays, many = np.ones((4, 6)), np.ones((200_000, 6))
        simulation = Simulation(Scene.load(PLANE))
        calls = [
            lambda: caster.cast(rays),
            lambda: caster.cast(many),
            lambda: caster.nearest(rays[:, :3]),
            lambda: list(simulation.frames()),
            lambda: simulation.frame(2).truth,
        ]
        before = signal.signal(signal.SIGALRM, handler)
        try:
            for seed in range(120):
                draw, call = random.Random(seed), calls[seed % len(calls)]
                try:
                    signal.setitimer(signal.ITIMER_REAL, draw.uniform(1e-4, 2e-2))
                    while True:
                        call()
                except Raised:
                    pass
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)

    def test_no_frame_is_lost_when_progress_raises(self):
        simulation = Simulation(Scene.load(PLANE))
        for seed in range(4):
            draw, told = random.Random(seed), []

            def progress(done, total):
                told.append((done, total))
                if draw.random() < 0.5:
                    raise RuntimeError("not now")

            frames, numbers, raised = simulation.frames(progress=progress), [], 0
            while len(numbers) < 9 and raised < 1000:
                try:
                    numbers.append(next(frames).number)
                except RuntimeError:
                    raised += 1
            self.assertEqual(numbers, list(range(9)))
            self.assertGreater(raised, 0)
            self.assertEqual([t for t in told if t == (9, 9)][-1:], [(9, 9)])
            self.assertIsNone(next(frames, None))

    def test_a_subclass_of_ndarray_that_lies_about_its_shape_is_read_as_it_is(self):
        class Lies(np.ndarray):
            def reshape(self, *shape):
                return np.asarray(self)[:, :2]

            def copy(self):
                return np.asarray(self)[:1, :1]

        caster = RayCaster(np.eye(3), np.array([[0, 1, 2]]))
        rays = np.tile([0.2, 0.2, 9, 0, 0, -1.0], (5, 1))
        truth = caster.cast(rays)
        np.testing.assert_array_equal(caster.cast(rays.view(Lies)), truth)
        np.testing.assert_array_equal(caster.cast(rays[::-1].view(Lies)), truth)
        self.assertEqual(RayCaster(np.eye(3).view(Lies), np.array([[0, 1, 2]]).view(Lies)).triangle_count, 1)

    def test_too_little_memory_is_a_memory_error(self):
        caster = RayCaster(np.eye(3), np.array([[0, 1, 2]]))
        for count in [10**13, 10**14, 10**15]:
            with self.assertRaises(MemoryError):
                caster.cast(np.broadcast_to(np.ones(6), (count, 6)))

    def test_rays_of_any_size_are_cast_or_refused(self):
        caster = RayCaster(np.eye(3) * 10, np.array([[0, 1, 2]]))
        for seed in range(3):
            draw = np.random.default_rng(seed)
            for _ in range(300):
                rays = np.zeros((16, 6))
                rays[:] = draw.uniform(-300, 300, 6)
                size = 10.0 ** draw.uniform(-323, 300, (16, 3))
                rays[:, 3:] = size * draw.choice([-1.0, 0.0, 1.0], (16, 3))
                rays[:, 3 + draw.integers(3)] = draw.choice([-1.0, 1.0])
                try:
                    hits = caster.cast(rays, t_max=10.0 ** draw.uniform(-300, 300))
                    self.assertFalse(np.isnan(hits["distance"]).any())
                    caster.any_hit(rays)
                except Error as error:
                    self.assertRegex(str(error), r"^ray \d+: direction")


if __name__ == "__main__":
    unittest.main()
