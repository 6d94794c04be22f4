"""Reads a data set of `lasertrace dataset` and shows its first samples in one picture.

python3 examples/dataset/read.py out/set [overview.png]

Above each image; below it the depth, light where near, with the true line in red. Needs NumPy and Pillow.
"""

import hashlib
import io
import json
import sys
import tarfile
from pathlib import Path

import numpy as np
from PIL import Image


def samples(folder):
    """Each sample in order: image (rows, columns), truth (depth, normal, line, points), description."""
    index = json.loads((folder / "index.json").read_text())
    for file in index["files"]:
        path = folder / file["file"]
        if hashlib.file_digest(open(path, "rb"), "sha256").hexdigest() != file["sha256"]:
            raise ValueError(f"{path} is damaged: make it again")
        with tarfile.open(path) as tar:
            parts = {}
            for member in tar:
                key, ending = member.name.split(".", 1)
                parts[ending] = io.BytesIO(tar.extractfile(member).read())
                # The files of a sample stand together, the scene last.
                if ending == "toml":
                    image = np.asarray(Image.open(parts["png"]))
                    yield image, np.load(parts["npz"]), json.load(parts["json"])


def half(gray):
    """Half as large: the brightest of four, so that a line stays whole."""
    rows, columns = gray.shape[0] // 2, gray.shape[1] // 2
    return gray[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).max(axis=(1, 3))


def picture(image, truth):
    """The image, the true line, and the depth, one below the other."""
    gray = half(np.sqrt(np.clip(image / max(np.percentile(image, 99.9), 1), 0, 1)))
    depth, shade = truth["depth"], np.zeros(image.shape)
    seen = np.isfinite(depth)
    if seen.any():
        near, far = depth[seen].min(), depth[seen].max()
        shade[seen] = 1 - 0.8 * (depth[seen] - near) / max(far - near, 1e-6)
    both = np.repeat(np.concatenate([gray, half(shade)])[..., None], 3, axis=2)
    row = truth["line"]["row_px"].astype(int) // 2 + gray.shape[0]
    both[np.minimum(row, len(both) - 1), truth["line"]["column"] // 2] = [1, 0, 0]
    return (255 * both).astype(np.uint8)


def main():
    folder = Path(sys.argv[1])
    target = Path(sys.argv[2]) if len(sys.argv) > 2 else folder / "overview.png"
    pictures = []
    for image, truth, described in samples(folder):
        print(f"{described['sample']}: frame {described['frame']}, {len(truth['points'])} points, {described['values']}")
        if len(pictures) < 8:
            pictures.append(picture(image, truth))
    rows = [np.concatenate(pictures[i : i + 4], axis=1) for i in range(0, len(pictures), 4)]
    width = max(row.shape[1] for row in rows)
    rows = [np.pad(row, ((0, 8), (0, width - row.shape[1]), (0, 0))) for row in rows]
    Image.fromarray(np.concatenate(rows)).save(target)
    print(target)


if __name__ == "__main__":
    main()
