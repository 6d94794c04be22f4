"""Simulator of laser-triangulation inspection, and ray casting.

From a CAD mesh and the description of a sensor to the images it would take and the 3D points
it would measure, with how far and how surely they lie from the CAD:

>>> import lasertrace
>>> scene = lasertrace.Scene.load("scenes/bracket/scene.toml")
>>> simulation = lasertrace.Simulation(scene.with_values({"camera.f_number": 11}))
>>> for frame in simulation.frames(range(80, 90)):
...     frame.image                  # uint16, (rows, columns)
...     frame.depth                  # float32, (rows, columns): the truth
...     frame.points["deviation"]    # mm, one a measured point

Rays against triangles, settled in float64, in the manner of Open3D and trimesh:

>>> caster = lasertrace.RayCaster(vertices, triangles)
>>> hits = caster.cast(rays)         # (n, 6): origin and direction
>>> hits["distance"], hits["triangle"]

Lengths are millimetres. A mistake raises lasertrace.Error, a ValueError that says what was
found, what was expected and what to do. Python's other threads run on while lasertrace
works, and Ctrl-C ends it.
"""

import enum as _enum

try:
    from . import _core
except ImportError as _error:
    if "libembree" in str(_error) or "libtbb" in str(_error):
        raise ImportError(
            f"lasertrace needs Embree, which is not installed ({_error}): on Debian run "
            "`apt-get install libembree3-3` (Debian 12) or `apt-get install libembree4-4` "
            "(Debian 13)"
        ) from None
    raise

from ._core import Error, Frame, Frames, Scene, Simulation, engine
from ._rays import MISS, RayCaster

__version__ = _core.__version__


class Flag(_enum.IntFlag):
    """What is doubtful about a point; of several, the sum.

    >>> sound = frame.points[frame.points["flags"] & ~np.uint32(Flag.UNCERTAINTY_NOT_VALID) == 0]
    >>> Flag(frame.points["flags"][0])
    """

    SATURATED = 1
    """The line loses half its light or more above the highest count the sensor gives."""
    MULTIPLE_PEAKS = 2
    """The column holds another line: a second surface, or a ghost."""
    WIDE = 4
    """More than twice as wide as the frame's lines where they run as steeply."""
    LOW_SIGNAL = 8
    """Near the noise, or much fainter than the frame's lines and not cut by an edge."""
    IMAGE_BORDER = 16
    """Cut off by the sensor's edge."""
    DISCONTINUITY = 32
    """At an end or a jump, or so narrow or dark that an edge may cut the line."""
    UNCERTAINTY_NOT_VALID = 64
    """Outside the domain of the stated uncertainty."""
    SUSPECTED_REFLECTION = 128
    """Possibly a reflection."""
    INTERPOLATED = 256
    """Put into a gap between measured points; in the files of a scan only."""


def _unpickled_scene(text, folder):
    """The scene of a pickle, which names this function."""
    return Scene.parse(text, folder)


def _unpickled_simulation(scene, threads):
    """The simulation of a pickle, which names this function."""
    return Simulation(scene, threads=threads)


__all__ = [
    "Error", "Flag", "Frame", "Frames", "MISS", "RayCaster", "Scene", "Simulation", "engine",
]
