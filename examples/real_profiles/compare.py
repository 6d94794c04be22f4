"""Profiles across a round bar: those of a laser-triangulation sensor, and simulated ones, before and after filters.

    python3 examples/real_profiles/compare.py lasertrace FOLDER-OF-HEIGHT-MAPS docs

`lasertrace` is the program; the folder holds sick_AnalyzeHeightMap_heightMap.json (github.com/sick-appspace-samples/AnalyzeHeightMap, public
domain). Writes real-profiles.md and real-profiles.svg. Needs NumPy.
"""
import base64, json, subprocess, sys, tempfile
from pathlib import Path
import numpy as np

HERE = Path(__file__).parent


def real(folder):
    """(column, x, z) of profiles across the bar: rows 420 to 740 of the map, columns on which it lies."""
    found = json.loads((Path(folder) / "sick_AnalyzeHeightMap_heightMap.json").read_text())
    found = found if isinstance(found, list) else [found]
    data = next(o for o in found if o.get("class") == "Image")["data"]
    image = data["Data"]
    kind = np.dtype(image["Pixels"]["elemTypes"][0]).newbyteorder(">" if image["Pixels"]["endian"] == "big" else "<")
    heights = np.frombuffer(base64.b64decode(image["Pixels"]["data"]), kind)
    heights = heights.reshape(image["Height"], image["Width"]).astype(float)
    size = data["PixelSize"]
    columns = np.arange(251, 358)
    for row in heights[420:740:4]:
        # The table lies at 2900 counts, the bar's lowest points above 3300; 0 is missing.
        there = row[columns] > 3300
        yield columns[there], columns[there] * size["x"], row[columns][there] * size["z"]


def simulated(program, measure):
    """The same of the scene with these keys in [measure], of points without a flag but UNCERTAINTY_NOT_VALID (64)."""
    with tempfile.TemporaryDirectory() as out:
        scene = HERE / f"bar-{len(measure)}.part.toml"
        scene.write_text((HERE / "bar.toml").read_text() + "\n[measure]\n" + measure)
        try:
            subprocess.run([program, "--quiet", "scan", scene, "-o", out], check=True, stdout=subprocess.DEVNULL)
        finally:
            scene.unlink()
        points = np.load(Path(out) / "profiles.npy")
    valid = points[(points["flags"] & ~np.uint16(64)) == 0]
    step = 200.0 if "resample_spacing_um" in measure else None
    profiles = []
    for frame in np.unique(valid["frame"]):
        p = valid[valid["frame"] == frame]
        column = np.round(p["x_mm"] / 0.2).astype(int) if step else p["column"].astype(int)
        profiles.append((column, p["x_mm"], p["z_mm"]))
    return profiles, valid


def residuals(x, z):
    """Of the circle that fits best, points off by more than five deviations left out, and its slope at each point."""
    c = np.linalg.lstsq(np.c_[2 * x, 2 * z, np.ones_like(x)], x * x + z * z, rcond=None)[0]
    p = np.array([c[0], c[1], np.sqrt(c[2] + c[0] ** 2 + c[1] ** 2)])
    kept = np.ones(len(x), bool)
    for step in range(15):
        d = np.hypot(x - p[0], z - p[1])
        r = d - p[2]
        if step > 4:
            kept = np.abs(r) < 5 * 1.4826 * np.median(np.abs(r[kept]))
        a = np.c_[-(x - p[0]) / d, -(z - p[1]) / d, -np.ones_like(x)]
        p = p - np.linalg.lstsq(a[kept], r[kept], rcond=None)[0]
    r = np.hypot(x - p[0], z - p[1]) - p[2]
    return r, np.degrees(np.arcsin(np.clip(np.abs(x - p[0]) / p[2], 0, 1))), kept


def figures(profiles):
    """Residuals' rms and correlation from column to column: all, and less the mean over profiles; and slopes at the ends."""
    rows, ends = [], []
    for column, x, z in profiles:
        if len(x) < 25:
            continue
        r, slope, kept = residuals(x, z)
        rows.append(dict(zip(column[kept], 1e3 * r[kept])))
        ends += [slope[kept][0], slope[kept][-1]]
    columns = sorted(set.union(*[set(row) for row in rows]))
    table = np.array([[row.get(c, np.nan) for c in columns] for row in rows])
    # Columns that most profiles have.
    table[:, np.isfinite(table).sum(0) < len(rows) / 2] = np.nan
    beside = np.diff(columns) == 1

    def of(t):
        product = (t[:, :-1] * t[:, 1:])[:, beside]
        square = (t[:, :-1] ** 2)[:, beside]
        both = np.isfinite(product)
        return np.sqrt(np.nanmean(t**2)), product[both].sum() / square[both].sum()

    fixed = np.full(table.shape[1], np.nan)
    some = np.isfinite(table).any(0)
    fixed[some] = np.nanmean(table[:, some], axis=0)
    return of(table) + of(table - fixed) + (np.median(ends),), (np.array(columns), table)


def picture(curves):
    text = ["<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 900 %d' font-family='sans-serif' font-size='12'>" % (60 + 150 * len(curves)),
            "<rect width='900' height='100%' fill='white'/>",
            "<text x='60' y='24' font-weight='bold' font-size='15'>One profile across a bar of 22.5 mm less the circle that fits best, µm</text>"]
    for k, (name, pitch, columns, values) in enumerate(curves):
        top, there = 50 + 150 * k, np.isfinite(values)
        x = (columns - columns[there].mean()) * pitch
        text.append(f"<text x='60' y='{top - 4}'>{name}</text><rect x='60' y='{top}' width='800' height='120' fill='none' stroke='#333'/>")
        text.append(f"<line x1='60' x2='860' y1='{top + 60}' y2='{top + 60}' stroke='#bbb'/>")
        for v in (-200, 0, 200):
            text.append(f"<text x='54' y='{top + 64 - v * 0.25}' text-anchor='end'>{v}</text>")
        points = " ".join(f"{460 + 34 * a:.1f},{top + 60 - 0.25 * float(np.clip(v, -240, 240)):.1f}" for a, v in zip(x[there], values[there]))
        text.append(f"<polyline fill='none' stroke='#2471a3' points='{points}'/>")
    bottom = 50 + 150 * len(curves) - 12
    text += [f"<text x='{460 + 34 * a}' y='{bottom}' text-anchor='middle'>{a}</text>" for a in range(-10, 11, 5)]
    return "\n".join(text + [f"<text x='860' y='{bottom}' text-anchor='end'>mm</text></svg>\n"])


PAGE = """# Real profiles compared with the model

This page is written by `python3 examples/real_profiles/compare.py lasertrace HEIGHT-MAPS docs`. The real data are 80 profiles across a round bar of some 22.5 mm,
from a height map of a laser-triangulation sensor (TriSpectorP or Ranger type; spacing 0.202 mm, height steps of 4.5 µm; public domain). The file does not state
optics and filters. The simulation scans a bar of this radius with `sensors/generic-100mm-660nm.toml` (columns 0.08 mm wide), before and after filters of `[measure]`. A circle
is fitted to each profile.

![one profile of each, minus its circle](real-profiles.svg)

| profiles | spacing, mm | residual rms, µm | correlation of neighbours | without the common part: rms, µm | correlation | slope at the ends |
|---|---|---|---|---|---|---|
{table}

{verdict}
"""


def main(program, folder, docs):
    cases = [
        ("simulated, as measured", 0.08, ""),
        ("simulated, mean of 3 columns", 0.08, "moving_average_columns = 3\n"),
        ("simulated, mean of 7 columns", 0.08, "moving_average_columns = 7\n"),
        ("simulated, median of 7 columns", 0.08, "median_filter_columns = 7\n"),
        ("simulated, mean of 3 columns, resampled", 0.2, "moving_average_columns = 3\nresample_spacing_um = 200\n"),
    ]
    rows = [("real", 0.202, *figures(list(real(folder))))]
    for name, pitch, measure in cases:
        profiles, points = simulated(program, measure)
        rows.append((name, pitch, *figures(profiles)))
        share = np.median(points["correlation_length_mm"]) / pitch
        print(f"{name}: stated sigma {1e3 * np.median(points['u_position_mm']):.1f} µm, alike over {share:.2f} points")
    lines = []
    for name, pitch, (rms, rho, own, own_rho, end), _ in rows:
        lines.append(f"| {name} | {pitch} | {rms:.0f} | {rho:.2f} | {own:.1f} | {own_rho:.2f} | {end:.0f}° |")
    chosen = [rows[0], rows[1], rows[3], rows[5]]
    curves = [(f"{name}, a point every {pitch} mm", pitch, columns, table[len(table) // 2]) for name, pitch, _, (columns, table) in chosen]
    verdict = (HERE / "verdict.md").read_text().strip()
    (Path(docs) / "real-profiles.svg").write_text(picture(curves))
    (Path(docs) / "real-profiles.md").write_text(PAGE.format(table="\n".join(lines), verdict=verdict))
    print("\n".join(lines))


if __name__ == "__main__":
    main(*sys.argv[1:4])
