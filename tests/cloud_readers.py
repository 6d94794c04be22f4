#!/usr/bin/env python3
"""Opens a scan's cloud.ply with the programs others use, and holds what they read against the profiles.

    python3 tests/cloud_readers.py out/scan

Open3D, trimesh and plyfile (each from PyPI) are used as far as they are installed; those that are not are
named. Exit code 1 if one reads something else, or if none is there.
"""

import importlib
import pathlib
import sys

import numpy

FLOATS = ["nx", "ny", "nz", "deviation", "sigma", "deviation_sigma", "intensity", "repeatability", "correlation_length"]
INTEGERS = ["red", "green", "blue", "frame", "column", "flags"]


def profiles(folder):
    """Frame, column and position (mm) of each point, as profiles.npy has them."""
    rows = numpy.load(folder / "profiles.npy")
    return rows[["frame", "column", "x_mm", "y_mm", "z_mm"]].tolist()


def by_plyfile(module, path):
    vertices = module.PlyData.read(path)["vertex"]
    return {name: vertices[name] for name in ["x", "y", "z"] + FLOATS + INTEGERS}


def by_trimesh(module, path):
    cloud = module.load(path)
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    table = {name: data[name].reshape(-1) for name in FLOATS + INTEGERS}
    table.update(zip("xyz", cloud.vertices.T))
    table.update(zip(["red", "green", "blue"], cloud.colors.T))
    return table


def by_open3d(module, path):
    cloud = module.t.io.read_point_cloud(path).point
    table = {name: cloud[name].numpy().reshape(-1) for name in FLOATS[3:] + INTEGERS[3:]}
    table.update(zip("xyz", cloud["positions"].numpy().T))
    table.update(zip(["nx", "ny", "nz"], cloud["normals"].numpy().T))
    table.update(zip(["red", "green", "blue"], cloud["colors"].numpy().T))
    return table


def mistakes(table, expected):
    """What is wrong with a table of columns."""
    count = len(expected)
    for name, column in table.items():
        if len(column) != count:
            yield f"{name} has {len(column)} values, expected {count}, one a point"
    for place, name in enumerate(["frame", "column"]):
        if any(int(found) != row[place] for found, row in zip(table[name], expected)):
            yield f"{name} is not that of the profiles"
    for place, name in enumerate("xyz", 2):
        # Readers that narrow to f32 lose up to 2^-24 of the number.
        if any(abs(found - row[place]) > 6e-8 * abs(row[place]) for found, row in zip(table[name], expected)):
            yield f"{name} is not that of the profiles"
    lengths = (table["nx"] ** 2 + table["ny"] ** 2 + table["nz"] ** 2) ** 0.5
    if any(abs(length - 1) > 1e-6 for length in lengths):
        yield "normals are not of unit length"
    if not all(0 <= int(flags) < 256 for flags in table["flags"]):
        yield "flags are not between 0 and 255"
    if len(set(zip(table["red"].tolist(), table["green"].tolist(), table["blue"].tolist()))) < 2:
        yield "all points have one colour"


def main():
    folder = pathlib.Path(sys.argv[1])
    expected = profiles(folder)
    wrong, opened = False, 0
    for name, read in [("open3d", by_open3d), ("trimesh", by_trimesh), ("plyfile", by_plyfile)]:
        try:
            module = importlib.import_module(name)
        except ImportError:
            print(f"{name}: not installed, skipped")
            continue
        version = importlib.import_module("importlib.metadata").version(name)
        found = list(mistakes(read(module, str(folder / "cloud.ply")), expected))
        opened += 1
        wrong |= bool(found)
        print(f"{name} {version}: {'; '.join(found) or f'{len(expected)} points with all their columns'}")
    sys.exit(wrong or not opened)


main()
