from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from . import _core

NOTHING: np.uint32

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
        *,
        multiple_hits: Literal[False],
    ) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.int64]]: ...
