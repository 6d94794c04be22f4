"""Ray casting by the names that users of Open3D and trimesh know."""

import numpy as np

from ._core import Error
from ._core import RayCaster as _RayCaster

NOTHING = np.uint32(0xFFFFFFFF)
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

    The names of the others are there too, and give NumPy arrays. Any number of Python's
    threads may use one caster.
    """

    __slots__ = ()

    def cast_rays(self, rays):
        """As Open3D's: a dict of t_hit, geometry_ids, primitive_ids and primitive_uvs.

        They are views of what `cast` returns, float64 and uint32. geometry_ids number the
        instances. t_hit is inf, and ids are NOTHING, where a ray meets nothing.
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
        return np.where(triangle == NOTHING, -1, triangle.astype(np.int64))

    def intersects_location(self, ray_origins, ray_directions, *, multiple_hits):
        """As trimesh's: places, numbers of the rays that meet something, and triangles.

        Of each ray the first hit alone: multiple_hits=False must be said.
        """
        if multiple_hits:
            raise Error(
                f"multiple_hits: found {multiple_hits!r}, expected False: a ray ends at its first "
                "hit here"
            )
        hits = self.cast(_rays(ray_origins, ray_directions))
        met = np.flatnonzero(hits["triangle"] != NOTHING)
        return hits["point"][met], met, hits["triangle"][met].astype(np.int64)


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
