"""Ray casting by the names that users of Open3D and trimesh know."""

import numpy as np

from ._core import Error
from ._core import RayCaster as _RayCaster

MISS = np.uint32(0xFFFFFFFF)
"""Number of the triangle and instance where a ray meets nothing."""


class RayCaster(_RayCaster):
    """Triangles that rays are cast at.

    RayCaster(vertices, triangles, *, instances=None, backend="embree", threads=None)

    `vertices`: an array (n, 3), float32 or float64; `triangles`: whole numbers (m, 3). Both
    are copied. `instances`: matrices (k, 4, 4), rotation and translation, for copies of the
    mesh that share its memory. `backend`: "embree", or "rust", which is slower
    and loses no ray; of rays exactly at a vertex of a surface that is open Embree loses about 1 in 100
    to 1 in 10 000. `threads`: at most so many; None: all that the machine grants.

    >>> caster = RayCaster(np.eye(3), np.array([[0, 1, 2]]))
    >>> caster.cast(np.array([[0.2, 0.2, 5.0, 0, 0, -1]]))["distance"]
    array([4.4])

    | here | Open3D RaycastingScene | trimesh RayMeshIntersector |
    | cast | cast_rays | intersects_first, intersects_location |
    | any_hit | test_occlusions | intersects_any |
    | nearest | compute_closest_points, compute_distance | |
    | all_hits | list_intersections | intersects_location, intersects_id |
    | count_hits | count_intersections | |
    | contains_points | compute_occupancy | contains_points |
    | signed_distance | compute_signed_distance | |
    | winding_number, thickness, cast_batches | | |

    The names of the others are there too, and give NumPy arrays. Any number of Python's
    threads may use one caster.
    """

    __slots__ = ()

    def cast_rays(self, rays):
        """As Open3D's: a dict of t_hit, geometry_ids, primitive_ids and primitive_uvs.

        They are views of what `cast` returns, float64 and uint32. geometry_ids number the
        instances. t_hit is inf, and ids are MISS, where a ray meets nothing.
        """
        hits = self.cast(rays)
        return {
            "t_hit": hits["distance"],
            "geometry_ids": hits["instance"],
            "primitive_ids": hits["triangle"],
            "primitive_uvs": hits["barycentric"],
        }

    def test_occlusions(self, rays, tfar=np.inf):
        """As Open3D's: whether each ray meets anything up to `tfar`."""
        return self.any_hit(rays, t_max=tfar)

    def compute_closest_points(self, query_points):
        """As Open3D's: a dict of points, geometry_ids, primitive_ids and primitive_uvs."""
        places = self.nearest(query_points)
        return {
            "points": places["point"],
            "geometry_ids": places["instance"],
            "primitive_ids": places["triangle"],
            "primitive_uvs": places["barycentric"],
        }

    def compute_distance(self, query_points):
        """As Open3D's: distance to the nearest place of the mesh."""
        return self.nearest(query_points)["distance"]

    def intersects_any(self, ray_origins, ray_directions):
        """As trimesh's: whether each ray meets anything."""
        return self.any_hit(_rays(ray_origins, ray_directions))

    def intersects_first(self, ray_origins, ray_directions):
        """As trimesh's: the triangle that each ray meets first, -1 where it meets none."""
        triangle = self.cast(_rays(ray_origins, ray_directions))["triangle"]
        return np.where(triangle == MISS, -1, triangle.astype(np.int64))

    def intersects_location(self, ray_origins, ray_directions, multiple_hits=True):
        """As trimesh's: locations, indices of the rays, and triangles, for each hit.

        Hits are in the order of the rays, and the hits of one ray in order of distance. Each
        surface is hit once, also at a common edge or vertex of triangles.
        """
        hits, ray, _ = self._listed(ray_origins, ray_directions, multiple_hits, None)
        return hits["point"], ray, hits["triangle"].astype(np.int64)

    def intersects_id(
        self,
        ray_origins,
        ray_directions,
        multiple_hits=True,
        max_hits=None,
        return_locations=False,
    ):
        """As trimesh's: triangles and indices of the rays, for each hit, and locations if wanted.

        `max_hits`: largest number of hits per ray; None: all.
        """
        hits, ray, _ = self._listed(ray_origins, ray_directions, multiple_hits, max_hits)
        triangle = hits["triangle"].astype(np.int64)
        return (triangle, ray, hits["point"]) if return_locations else (triangle, ray)

    def _listed(self, origins, directions, multiple_hits, max_hits):
        """All hits, the index of the ray of each, and whether the ray enters there."""
        rays = _rays(origins, directions)
        hits, starts, entering = self.all_hits(rays, limit=max_hits if multiple_hits else 1)
        return hits, np.repeat(np.arange(len(rays)), np.diff(starts)), entering

    def list_intersections(self, rays):
        """As Open3D's: a dict of ray_splits, ray_ids, t_hit, geometry_ids, primitive_ids and
        primitive_uvs, for all hits.

        The hits of ray i are ray_splits[i] to ray_splits[i + 1], in order of distance.
        """
        hits, starts, _ = self.all_hits(rays)
        return {
            "ray_splits": starts,
            "ray_ids": np.repeat(np.arange(len(starts) - 1), np.diff(starts)),
            "t_hit": hits["distance"],
            "geometry_ids": hits["instance"],
            "primitive_ids": hits["triangle"],
            "primitive_uvs": hits["barycentric"],
        }

    def count_intersections(self, rays):
        """As Open3D's: the number of hits of each ray, int64."""
        return self.count_hits(rays).view(np.int64)

    def compute_signed_distance(self, query_points):
        """As Open3D's: distance to the closed mesh, negative inside."""
        return self.signed_distance(query_points)

    def compute_occupancy(self, query_points):
        """As Open3D's: 1 for points inside the closed mesh and 0 outside, float32."""
        return self.contains_points(query_points).astype(np.float32)

    def cast_batches(self, rays, *, t_max=np.inf, batch=2**20, progress=None):
        """Iterate over the hits of any number of rays in constant memory.

        `rays` is an array (n, 6), which may be a memory map, or an iterable of such arrays, for
        example a generator. Yields an array of hits, as `cast` returns it, for each `batch` rays of
        an array, or for each array of an iterable. No batch is kept, therefore memory does not
        depend on the number of rays.

        `progress(done, total)` is called after each batch; `total` is None for an iterable. An
        exception that it raises, and Ctrl-C, end the iteration.

        >>> for hits in caster.cast_batches(np.load("rays.npy", mmap_mode="r")):
        ...     total += np.isfinite(hits["distance"]).sum()
        """
        if isinstance(batch, bool) or not isinstance(batch, (int, np.integer)) or batch < 1:
            raise Error(f"batch: found {batch!r}, expected a whole number from 1")
        is_array = isinstance(rays, np.ndarray)
        if is_array and (rays.ndim != 2 or rays.shape[1] != 6):
            raise Error(f"rays: found shape {rays.shape}, expected an array of shape (n, 6)")
        return self._batches(rays, t_max, int(batch), progress, is_array)

    def _batches(self, rays, t_max, batch, progress, is_array):
        done, total = 0, len(rays) if is_array else None
        batches = rays
        if is_array:
            batches = (rays[first : first + batch] for first in range(0, total, batch))
        for some in batches:
            hits = self.cast(some, t_max=t_max)
            done += hits.size
            # Not referenced here while the caller works, so that only one batch is in memory.
            del some
            if progress is not None:
                progress(done, total)
            yield hits
            del hits


def _rays(origins, directions):
    """Origins and directions, (n, 3) each, as rays (n, 6)."""
    for name, given in [("ray_origins", origins), ("ray_directions", directions)]:
        shape = getattr(given, "shape", type(given).__name__)
        if not (isinstance(shape, tuple) and len(shape) == 2 and shape[1] == 3):
            raise Error(f"{name}: found {shape}, expected a NumPy array of shape (n, 3)")
    if len(origins) != len(directions):
        raise Error(
            f"ray_directions: found {len(directions)}, expected {len(origins)}, one a ray_origin"
        )
    return np.concatenate([origins, directions], axis=1)
