"""Runs the tool of reference of EMVA 1288 (PyPI `emva1288`) on what `lasertrace emva` wrote, and compares what it finds with
what was put in: each within 2 %.

    python3 tests/emva.py FOLDER
"""
import json
import logging
import sys
from pathlib import Path

from emva1288.process.data import Data1288
from emva1288.process.loader import LoadImageData
from emva1288.process.parser import ParseEmvaDescriptorFile
from emva1288.process.results import Results1288

folder = Path(sys.argv[1])
put_in = json.loads((folder / "emva.json").read_text())
level = logging.WARNING
images = ParseEmvaDescriptorFile(str(folder / "EMVA1288descriptor.txt"), loglevel=level).images
data = Data1288(LoadImageData(images, loglevel=level).data, loglevel=level).data
found = Results1288(data, loglevel=level)

figures = [
    ("QE", "%", found.QE, put_in["quantum_efficiency_percent"]),
    ("K", "DN/e", found.K, put_in["gain_dn_per_e"]),
    ("read noise", "e", found.sigma_d, put_in["read_noise_e"]),
    ("full well", "e", found.u_e_sat, put_in["saturation_e"]),
    ("DSNU", "e", found.DSNU1288, put_in["dsnu_e"]),
    ("PRNU", "%", found.PRNU1288, put_in["prnu_percent"]),
]
worst = 0.0
for name, unit, value, true in figures:
    off = value / true - 1.0
    worst = max(worst, abs(off))
    print(f"{name}: {value:.4g} {unit}, put in {true:.4g}: {100 * off:+.2f} %")
print(f"worst {100 * worst:.2f} %")
sys.exit(1 if worst > 0.02 else 0)
