"""PyTorch data set of the samples of `lasertrace dataset`. Needs PyTorch, NumPy and Pillow."""

import io, json, os, tarfile
from pathlib import Path

import numpy, torch
from PIL import Image


class Frames(torch.utils.data.Dataset):
    """Images and line masks of a data set."""

    def __init__(self, folder):
        self.samples = []
        for file in json.loads((Path(folder) / "index.json").read_text())["files"]:
            path = Path(folder) / file["file"]
            with tarfile.open(path) as tar:
                at = {member.name: (member.offset_data, member.size) for member in tar}
            keys = sorted({name.split(".")[0] for name in at})
            self.samples += [(path, at[f"{key}.png"], at[f"{key}.npz"]) for key in keys]

    def __len__(self):
        return len(self.samples)

    def __getitem__(self, number):
        path, *parts = self.samples[number]
        with open(path, "rb") as file:
            png, npz = (io.BytesIO(os.pread(file.fileno(), size, start)) for start, size in parts)
        image = numpy.asarray(Image.open(png)).astype(numpy.float32)
        return torch.from_numpy(image), torch.from_numpy(numpy.load(npz)["mask"])
