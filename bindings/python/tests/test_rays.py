"""Rays against triangles: right answers, by the names of others too, from any memory layout."""

import itertools
import os
import resource
import sys
import threading
import unittest
from pathlib import Path

import numpy as np
from lasertrace import MISS, RayCaster

sys.path.insert(0, str(Path(__file__).parents[1]))
from bench_rays import INSIDE, UNCERTAINTY_NOT_VALID, at_vertices_and_edges, sphere

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])
# From above: the first half, the second, beside; from below; along.
RAYS = np.array(
    [
        [0.75, 0.25, 2, 0, 0, -1],
        [0.25, 0.75, 2, 0, 0, -0.5],
        [1.5, 0.5, 2, 0, 0, -1],
        [0.75, 0.25, -3, 0, 0, 1],
        [0.5, 0.5, 1, 0, 0, 1],
    ]
)


class Rays(unittest.TestCase):
    def both(self):
        for backend in ["embree", "rust"]:
            with self.subTest(backend=backend):
                yield RayCaster(SQUARE, HALVES, backend=backend)

    def test_hits_are_those_of_plain_geometry(self):
        for caster in self.both():
            hits = caster.cast(RAYS)
            nothing = int(MISS)
            np.testing.assert_array_equal(hits["triangle"], [0, 1, nothing, 0, nothing])
            np.testing.assert_array_equal(hits["instance"], [0, 0, nothing, 0, nothing])
            # All numbers are powers of two and their sums: exact.
            np.testing.assert_array_equal(hits["distance"], [2, 4, np.inf, 3, np.inf])
            np.testing.assert_array_equal(hits["point"][1], [0.25, 0.75, 0])
            np.testing.assert_array_equal(hits["point"][2], 0)
            u, v = hits["barycentric"][0]
            a, b, c = SQUARE[HALVES[0]]
            np.testing.assert_array_equal((1 - u - v) * a + u * b + v * c, [0.75, 0.25, 0])
            np.testing.assert_array_equal(caster.any_hit(RAYS), [1, 1, 0, 1, 0])
            np.testing.assert_array_equal(caster.any_hit(RAYS, t_max=2.5), [1, 0, 0, 0, 0])

    def test_the_nearest_place(self):
        for caster in self.both():
            places = caster.nearest(np.array([[0.75, 0.25, -2], [4, 0.5, 4]]))
            np.testing.assert_array_equal(places["distance"], [2, 5])
            np.testing.assert_array_equal(places["point"], [[0.75, 0.25, 0], [1, 0.5, 0]])

    def test_names_of_open3d_and_trimesh_give_the_same(self):
        caster = RayCaster(SQUARE, HALVES)
        hits, dictionary = caster.cast(RAYS), caster.cast_rays(RAYS)
        names = ["t_hit", "geometry_ids", "primitive_ids", "primitive_uvs"]
        for name, field in zip(names, ["distance", "instance", "triangle", "barycentric"]):
            np.testing.assert_array_equal(dictionary[name], hits[field])
        np.testing.assert_array_equal(caster.test_occlusions(RAYS, tfar=2.5), [1, 0, 0, 0, 0])
        points = np.array([[4.0, 0.5, 4]])
        self.assertEqual(caster.compute_distance(points), [5])
        np.testing.assert_array_equal(caster.compute_closest_points(points)["points"], [[1, 0.5, 0]])

        origins, directions = RAYS[:, :3], RAYS[:, 3:]
        np.testing.assert_array_equal(caster.intersects_any(origins, directions), [1, 1, 0, 1, 0])
        first = caster.intersects_first(origins, directions)
        np.testing.assert_array_equal(first, [0, 1, -1, 0, -1])
        places, ray, triangle = caster.intersects_location(
            origins, directions, multiple_hits=False
        )
        again = caster.intersects_location(origins, directions)
        for one, other in zip(again, [places, ray, triangle]):
            np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(ray, [0, 1, 3])
        np.testing.assert_array_equal(triangle, [0, 1, 0])
        np.testing.assert_array_equal(places, hits["point"][[0, 1, 3]])

    def test_instances_are_met_where_they_are(self):
        poses = np.stack([np.eye(4), np.eye(4)])
        poses[1, :3, 3] = [10, 0, 1]
        caster = RayCaster(SQUARE, HALVES, instances=poses)
        rays = RAYS[:1] + np.array([[0.0, 0, 0, 0, 0, 0], [10, 0, 0, 0, 0, 0]])
        hits = caster.cast(rays)
        np.testing.assert_array_equal(hits["instance"], [0, 1])
        np.testing.assert_array_equal(hits["distance"], [2, 1])

    def test_any_layout_of_memory_gives_the_same(self):
        rng = np.random.default_rng(1)
        vertices, triangles = sphere(12)
        # float32 numbers, so that both types hold the same rays.
        rays = rng.normal(size=(1000, 6)).astype(np.float32).astype(np.float64)
        caster = RayCaster(vertices, triangles)
        expected = caster.cast(rays)
        self.assertGreater((expected["triangle"] != MISS).sum(), 100)
        wide = np.zeros((1000, 9))
        wide[:, 2:8] = rays
        packed = np.zeros(1000, dtype=[("odd", "u1"), ("ray", "6f8")])
        packed["ray"] = rays
        frozen = rays.copy()
        frozen.flags.writeable = False
        layouts = {
            "float32": rays.astype(np.float32),
            "by columns": np.asfortranarray(rays),
            "a part of rows": wide[:, 2:8],
            "backwards": rays[::-1].copy()[::-1],
            "unaligned": packed["ray"],
            "read-only": frozen,
            "more axes": rays.reshape(10, 100, 6),
        }
        for name, layout in layouts.items():
            with self.subTest(name):
                hits = caster.cast(layout)
                self.assertEqual(hits.shape, layout.shape[:-1])
                np.testing.assert_array_equal(hits.reshape(-1), expected)
        for kind in [np.int32, np.int64, np.uint32, np.uint64]:
            again = RayCaster(vertices.astype(np.float32).astype(float), triangles.astype(kind))
            self.assertEqual(again.triangle_count, len(triangles))

    def test_at_vertices_and_edges_no_ray_is_lost(self):
        """Of a closed mesh, from outside and from inside, by either backend."""
        vertices, triangles = sphere(100)
        for backend, eye in itertools.product(["embree", "rust"], [UNCERTAINTY_NOT_VALID, INSIDE]):
            rays = at_vertices_and_edges(vertices, triangles, eye)
            self.assertGreater(len(rays), 10000)
            hits = RayCaster(vertices, triangles, backend=backend).cast(rays)
            # In units of the direction's length, to the rounding of f64 for coordinates of 3,
            # a surface met at more than arcsin(0.1/4), and a hundred operations.
            self.assertLess(np.abs(hits["distance"] - 1).max(), 100 * 40 * 3 * 2**-53)

    def test_threads_give_the_same(self):
        vertices, triangles = sphere(30)
        rays = np.random.default_rng(2).normal(size=(20000, 6))
        one = RayCaster(vertices, triangles, threads=1).cast(rays)
        caster = RayCaster(vertices, triangles)
        results = [None] * 4

        def work(i):
            results[i] = caster.cast(rays)

        workers = [threading.Thread(target=work, args=(i,)) for i in range(4)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        for result in results:
            np.testing.assert_array_equal(result, one)

    def test_a_forked_process_has_threads_of_its_own(self):
        vertices, triangles = sphere(30)
        rays = np.random.default_rng(3).normal(size=(20000, 6))
        caster = RayCaster(vertices, triangles)
        expected = caster.cast(rays)
        child = os.fork()
        if child == 0:
            same = np.array_equal(caster.cast(rays), expected)
            os._exit(0 if same else 1)
        self.assertEqual(os.waitpid(child, 0)[1], 0)

    def test_an_array_is_taken_again(self):
        caster = RayCaster(SQUARE, HALVES)
        for rays in [RAYS, RAYS.reshape(5, 1, 6), RAYS[:0]]:
            expected, any_hit = caster.cast(rays), caster.any_hit(rays)
            nearest = caster.nearest(rays[..., :3])
            for stale in [0, 255]:
                hits, hit, places = (a.copy() for a in [expected, any_hit, nearest])
                for array in [hits, places]:
                    if array.size:
                        array.reshape(-1).view("u1")[:] = stale
                hit[...] = stale > 0
                self.assertIs(caster.cast(rays, out=hits), hits)
                self.assertIs(caster.any_hit(rays, out=hit), hit)
                self.assertIs(caster.nearest(rays[..., :3], out=places), places)
                np.testing.assert_array_equal(hits, expected)
                np.testing.assert_array_equal(hit, any_hit)
                np.testing.assert_array_equal(places, nearest)
        # What an error leaves are no hits.
        hits = caster.cast(RAYS)
        with self.assertRaises(ValueError):
            caster.cast(RAYS * np.nan, out=hits)
        self.assertTrue((hits["triangle"] == MISS).all())

    def test_all_hits_are_once_each_in_order(self):
        vertices, triangles = sphere(30)
        double = np.concatenate([vertices, vertices * 2])
        faces = np.concatenate([triangles, triangles + len(vertices)])
        targets = np.concatenate([vertices, vertices[triangles[:, :2]].mean(axis=1)]) * 0.99
        eye = np.array([7.0, 1.0, 0.5])
        rays = np.concatenate([np.broadcast_to(eye, targets.shape), targets - eye], axis=1)
        results = []
        for backend in ["embree", "rust"]:
            caster = RayCaster(double, faces, backend=backend)
            hits, starts, entering = caster.all_hits(rays)
            counts = caster.count_intersections(rays)
            np.testing.assert_array_equal(counts, np.diff(starts))
            self.assertTrue((counts % 2 == 0).all())
            self.assertTrue(np.isin(counts, [2, 4]).all())
            listed = caster.list_intersections(rays)
            np.testing.assert_array_equal(listed["ray_splits"], starts)
            np.testing.assert_array_equal(listed["t_hit"], hits["distance"])
            for ray in range(0, len(rays), 17):
                own = slice(starts[ray], starts[ray + 1])
                self.assertTrue((np.diff(hits["distance"][own]) >= 0).all())
                self.assertEqual(np.where(entering[own], 1, -1).sum(), 0)
            some, ray = caster.intersects_id(rays[:, :3], rays[:, 3:], max_hits=2)
            self.assertEqual(len(some), np.minimum(counts, 2).sum())
            results.append(hits)
        np.testing.assert_array_equal(*results)

    def test_the_inside_of_a_closed_mesh(self):
        vertices, triangles = sphere(30)
        caster = RayCaster(vertices, triangles)
        points = np.random.default_rng(5).normal(size=(2000, 3))
        inside = caster.contains_points(points)
        self.assertGreater(inside.sum(), 100)
        np.testing.assert_array_equal(inside, np.rint(np.abs(caster.winding_number(points))) == 1)
        np.testing.assert_array_equal(inside, caster.signed_distance(points) < 0)
        np.testing.assert_array_equal(caster.compute_occupancy(points) == 1, inside)
        along = caster.thickness(np.array([[0.1, 0.2, 9.0, 0, 0, -2.0], [5.0, 5, 5, 0, 0, 1]]))
        hits, _, _ = caster.all_hits(np.array([[0.1, 0.2, 9.0, 0, 0, -2.0]]))
        # A hundred rounding errors of distances up to 10; the thickness is of unrefined hits.
        off = np.abs(along - [np.diff(hits["distance"])[0], 0])
        self.assertLess(off.max(), 100 * 10 * 2**-53)

    def test_batches_take_constant_memory(self):
        """Peak memory grows by less than the hits of four batches, for a total of 40."""
        caster = RayCaster(SQUARE, HALVES)
        batch, seen = 50_000, []

        def made():
            for _ in range(40):
                yield np.tile(RAYS, (batch // 5, 1))

        def hit(batches):
            return sum(int((hits["triangle"] != MISS).sum()) for hits in batches)

        hit(itertools.islice(caster.cast_batches(made()), 2))
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        progress = lambda done, total: seen.append((done, total))
        self.assertEqual(hit(caster.cast_batches(made(), progress=progress)), 40 * batch // 5 * 3)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        self.assertLess(grown * 1024, 4 * batch * (56 + 48))
        self.assertEqual((len(seen), seen[-1]), (40, (40 * batch, None)))
        rays = np.tile(RAYS, (9, 1))
        batches = list(caster.cast_batches(rays, batch=7))
        self.assertEqual([len(hits) for hits in batches], [7] * 6 + [3])
        np.testing.assert_array_equal(np.concatenate(batches), caster.cast(rays))
        self.assertEqual(list(caster.cast_batches(rays[:0])), [])

    def test_no_rays_no_hits(self):
        caster = RayCaster(SQUARE, HALVES)
        self.assertEqual(caster.cast(np.zeros((0, 6))).shape, (0,))
        self.assertEqual(caster.any_hit(np.zeros((3, 0, 6))).shape, (3, 0))


if __name__ == "__main__":
    unittest.main()
