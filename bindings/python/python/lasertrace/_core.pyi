import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, TypedDict, final, type_check_only

import numpy as np
from numpy.typing import NDArray
from typing_extensions import disjoint_base

__all__ = [
    "__version__", "Error", "FLAGS", "Scene", "Simulation", "Frames", "Frame", "RayCaster", "engine",
]

__version__: str
FLAGS: dict[str, int]

class Error(ValueError): ...

def engine(backend: Literal["embree", "rust"] = "embree") -> str: ...

@final
class Scene:
    @staticmethod
    def load(path: str | os.PathLike[str]) -> Scene: ...
    @staticmethod
    def parse(text: str, folder: str | os.PathLike[str] | None = None) -> Scene: ...
    @staticmethod
    def from_dict(values: dict[str, Any], folder: str | os.PathLike[str] | None = None) -> Scene: ...
    def with_values(self, values: dict[str, Any]) -> Scene: ...
    @property
    def text(self) -> str: ...
    @property
    def frames(self) -> int: ...
    @property
    def resolution(self) -> tuple[int, int]: ...
    @property
    def cameras(self) -> list[Scene]: ...

@final
class Simulation:
    def __new__(
        cls,
        scene: Scene,
        *,
        threads: int | None = None,
        progress: Callable[[float], object] | None = None,
    ) -> Simulation: ...
    @property
    def scene(self) -> Scene: ...
    @property
    def plan(self) -> list[tuple[str, str, str]]: ...
    def frame(self, number: int) -> Frame: ...
    def frames(
        self,
        numbers: range | Sequence[int] | NDArray[np.integer] | None = None,
        *,
        progress: Callable[[int, int], object] | None = None,
    ) -> Frames: ...
    def points(self, start: int | None = None, stop: int | None = None) -> NDArray[np.void]: ...
    def features(self) -> list[dict[str, Any]]: ...
    def __len__(self) -> int: ...

@final
class Frames(Iterator[Frame]):
    def __iter__(self) -> Frames: ...
    def __next__(self) -> Frame: ...
    def __length_hint__(self) -> int: ...

@type_check_only
class Truth(TypedDict):
    depth: NDArray[np.float32]
    position: NDArray[np.float32]
    normal: NDArray[np.float32]
    triangle: NDArray[np.uint32]
    copy: NDArray[np.uint32]

@final
class Frame:
    number: int
    image: NDArray[np.uint16] | None
    @property
    def points(self) -> NDArray[np.void]: ...
    @property
    def truth(self) -> Truth: ...
    @property
    def depth(self) -> NDArray[np.float32]: ...
    @property
    def part_from_camera(self) -> NDArray[np.float64]: ...
    @property
    def part_from_laser(self) -> NDArray[np.float64]: ...

@disjoint_base
class RayCaster:
    def __new__(
        cls,
        vertices: NDArray[np.floating],
        triangles: NDArray[np.integer],
        *,
        instances: NDArray[np.floating] | None = None,
        backend: Literal["embree", "rust"] = "embree",
        threads: int | None = None,
    ) -> RayCaster: ...
    def cast(
        self,
        rays: NDArray[np.floating],
        *,
        t_max: float = ...,
        out: NDArray[np.void] | None = None,
    ) -> NDArray[np.void]: ...
    def any_hit(
        self,
        rays: NDArray[np.floating],
        *,
        t_max: float = ...,
        out: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.bool_]: ...
    def nearest(
        self, points: NDArray[np.floating], *, out: NDArray[np.void] | None = None
    ) -> NDArray[np.void]: ...
    def all_hits(
        self, rays: NDArray[np.floating], *, t_max: float = ..., limit: int | None = None
    ) -> tuple[NDArray[np.void], NDArray[np.int64], NDArray[np.bool_]]: ...
    def count_hits(
        self, rays: NDArray[np.floating], *, t_max: float = ...
    ) -> NDArray[np.uint64]: ...
    def thickness(
        self, rays: NDArray[np.floating], *, t_max: float = ...
    ) -> NDArray[np.float64]: ...
    def contains_points(self, points: NDArray[np.floating]) -> NDArray[np.bool_]: ...
    def winding_number(self, points: NDArray[np.floating]) -> NDArray[np.float64]: ...
    def signed_distance(self, points: NDArray[np.floating]) -> NDArray[np.float64]: ...
    @property
    def triangle_count(self) -> int: ...
    @property
    def instance_count(self) -> int: ...
