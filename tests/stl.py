"""Binary STL."""
import numpy as np

ROW = np.dtype([("normal", "<3f4"), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read(path):
    """Corners of its triangles: count x 3 x 3."""
    with open(path, "rb") as file:
        data = file.read()
    (count,) = np.frombuffer(data, "<u4", 1, 80)
    return np.frombuffer(data, ROW, count, 84)["corners"]


def write(path, triangles):
    rows = np.zeros(len(triangles), ROW)
    rows["corners"] = triangles
    rows["normal"] = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    with open(path, "wb") as file:
        file.write(b"\0" * 80 + np.uint32(len(rows)).tobytes() + rows.tobytes())
