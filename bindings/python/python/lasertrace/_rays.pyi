from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _core

MISS: np.uint32

class RayCaster(_core.RayCaster):
    def cast_rays(self, rays: NDArray[np.floating]) -> dict[str, NDArray[Any]]: ...
    def test_occlusions(
        self, rays: NDArray[np.floating], tfar: float = ...
    ) -> NDArray[np.bool_]: ...
    def compute_closest_points(
        self, query_points: NDArray[np.floating]
    ) -> dict[str, NDArray[Any]]: ...
    def compute_distance(self, query_points: NDArray[np.floating]) -> NDArray[np.float64]: ...
    def intersects_any(
        self, ray_origins: NDArray[np.floating], ray_directions: NDArray[np.floating]
    ) -> NDArray[np.bool_]: ...
    def intersects_first(
        self, ray_origins: NDArray[np.floating], ray_directions: NDArray[np.floating]
    ) -> NDArray[np.int64]: ...
    def intersects_location(
        self,
        ray_origins: NDArray[np.floating],
        ray_directions: NDArray[np.floating],
        multiple_hits: bool = True,
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]: ...
    def intersects_id(
        self,
        ray_origins: NDArray[np.floating],
        ray_directions: NDArray[np.floating],
        multiple_hits: bool = True,
        max_hits: int | None = None,
        return_locations: bool = False,
    ) -> tuple[NDArray[Any], ...]: ...
    def list_intersections(self, rays: NDArray[np.floating]) -> dict[str, NDArray[Any]]: ...
    def count_intersections(self, rays: NDArray[np.floating]) -> NDArray[np.int64]: ...
    def compute_signed_distance(
        self, query_points: NDArray[np.floating]
    ) -> NDArray[np.float64]: ...
    def compute_occupancy(self, query_points: NDArray[np.floating]) -> NDArray[np.float32]: ...
    def cast_batches(
        self,
        rays: NDArray[np.floating] | Iterable[NDArray[np.floating]],
        *,
        t_max: float = ...,
        batch: int = ...,
        progress: Callable[[int, int | None], object] | None = None,
    ) -> Iterator[NDArray[np.void]]: ...
