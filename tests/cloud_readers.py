#!/usr/bin/env python3
"""Opens the clouds of a scan with other programs and compares what they read with the profiles.

    lasertrace scan SCENE --also e57,pcd -o out/scan
    python3 tests/cloud_readers.py out/scan [READER ...]

Readers are open3d, trimesh, plyfile, pye57 and pypcd4 (packages of PyPI) and cloudcompare (the program). Without
names all are tried, and those that are not installed are named. Exit code 1 if one reads something else, 3 if none is
installed.
"""

import importlib
import importlib.metadata
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile

import numpy

LENGTHS = ["deviation", "u_position", "u_deviation", "repeatability", "correlation_length", "scan_correlation_length"]
SCALARS = LENGTHS + ["frame", "column", "flags"]
PREFIX = "scalar_"


class Absent(Exception):
    """The reader is not installed."""


def package(name):
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Absent from error


def ply_table(read):
    """The columns of cloud.ply by a function from a property's name to its values."""
    table = {name: read(PREFIX + name) for name in SCALARS}
    return table | {name: read(name) for name in ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "intensity"]}


def by_plyfile(folder):
    vertices = package("plyfile").PlyData.read(str(folder / "cloud.ply"))["vertex"]
    return ply_table(lambda name: vertices[name])


def by_trimesh(folder):
    cloud = package("trimesh").load(str(folder / "cloud.ply"))
    data = cloud.metadata["_ply_raw"]["vertex"]["data"]
    table = ply_table(lambda name: data[name].reshape(-1))
    table.update(zip("xyz", cloud.vertices.T))
    table.update(zip(["red", "green", "blue"], cloud.colors.T))
    return table


def by_open3d(folder):
    cloud = package("open3d").t.io.read_point_cloud(str(folder / "cloud.ply")).point
    special = {"x": ("positions", 0), "y": ("positions", 1), "z": ("positions", 2)}
    special |= {name: ("normals", i) for i, name in enumerate(["nx", "ny", "nz"])}
    special |= {name: ("colors", i) for i, name in enumerate(["red", "green", "blue"])}

    def read(name):
        name, column = special.get(name, (name, 0))
        values = cloud[name].numpy()
        return values.reshape(len(values), -1)[:, column]

    return ply_table(read)


def by_cloudcompare(folder):
    program = shutil.which("CloudCompare") or shutil.which("cloudcompare.CloudCompare")
    if program is None:
        raise Absent
    with tempfile.TemporaryDirectory() as temporary:
        text = pathlib.Path(temporary) / "cloud.asc"
        command = [program, "-SILENT", "-AUTO_SAVE", "OFF", "-O", str(folder / "cloud.ply"), "-C_EXPORT_FMT", "ASC"]
        command += ["-PREC", "12", "-ADD_HEADER", "-SAVE_CLOUDS", "FILE", str(text)]
        environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
        subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        header = text.read_text().split("\n", 1)[0].lstrip("/").split()
        columns = numpy.loadtxt(text, skiprows=1, ndmin=2).T
    names = {"R": "red", "G": "green", "B": "blue"}
    return {names.get(name, name.lower()): column for name, column in zip(header, columns)}


def by_pye57(folder):
    file = package("pye57").E57(str(folder / "cloud.e57"))
    raw = file.read_scan_raw(0, ignore_unsupported_fields=True)
    scan = file.read_scan(0, intensity=True, colors=True, row_column=True)
    valid = raw["cartesianInvalidState"] == 0
    for name, values in scan.items():
        if not numpy.array_equal(values, raw[name][valid]):
            raise ValueError(f"read_scan and read_scan_raw differ in {name}")
    table = {name: 1e3 * scan[f"cartesian{name.upper()}"] for name in "xyz"}
    table |= {name: scan[f"color{name.title()}"] for name in ["red", "green", "blue"]}
    return table | {"intensity": scan["intensity"], "frame": scan["rowIndex"], "column": scan["columnIndex"]}


def by_pypcd4(folder):
    cloud = package("pypcd4").PointCloud.from_path(str(folder / "cloud.pcd"))
    table = dict(zip(cloud.fields, cloud.numpy(cloud.fields).T))
    for name in ["x", "y", "z"] + LENGTHS:
        table[name] = 1e3 * table[name].astype(float)
    return table


READERS = {
    "open3d": by_open3d,
    "trimesh": by_trimesh,
    "plyfile": by_plyfile,
    "cloudcompare": by_cloudcompare,
    "pye57": by_pye57,
    "pypcd4": by_pypcd4,
}
# pye57 reads the fields that E57 itself defines.
WANTED = {"pye57": ["x", "y", "z", "red", "green", "blue", "intensity", "frame", "column"]}


def mistakes(table, rows, wanted):
    """What is wrong with a table of columns."""
    names = {name: f"{name}_mm" for name in ["x", "y", "z"] + LENGTHS} | {"intensity": "intensity_dn"}
    for name in wanted:
        if name not in table:
            yield f"{name} is absent"
        elif len(table[name]) != len(rows):
            yield f"{name} has {len(table[name])} values, expected {len(rows)}, one a point"
        elif len(rows) == 0:
            continue
        elif names.get(name, name) in rows.dtype.names:
            expected = rows[names.get(name, name)].astype(float)
            # Numbers of 32 bits are off by 2^-24 of themselves; CloudCompare shifts positions by up to the largest.
            bound = 1.2e-7 * max(abs(expected).max(), 1e-3) if name in "xyz" else 1.2e-7 * abs(expected)
            if (abs(table[name] - expected) > bound).any():
                yield f"{name} is not that of the profiles"
    if len(rows) == 0:
        return
    if "nx" in table and any(abs(sum(table[name] ** 2 for name in ["nx", "ny", "nz"]) ** 0.5 - 1) > 1e-2):
        yield "normals are not of unit length"
    if "red" in table and len(set(zip(table["red"].tolist(), table["green"].tolist(), table["blue"].tolist()))) < 2:
        yield "all points have one colour"


def main():
    folder, names = pathlib.Path(sys.argv[1]), sys.argv[2:] or list(READERS)
    rows = numpy.load(folder / "profiles.npy")
    wrong, opened = False, 0
    for name in names:
        try:
            table = READERS[name](folder)
        except Absent:
            print(f"{name}: not installed, skipped")
            continue
        found = list(mistakes(table, rows, WANTED.get(name, ["x", "y", "z", "intensity"] + SCALARS)))
        opened += 1
        wrong |= bool(found)
        version = f" {importlib.metadata.version(name)}" if name != "cloudcompare" else ""
        print(f"{name}{version}: {'; '.join(found) or f'{len(rows)} points with all their columns'}")
    sys.exit(1 if wrong else 0 if opened else 3)


main()
