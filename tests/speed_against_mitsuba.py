"""How long light that is reflected more than once takes, over a frame of light reflected once and over Mitsuba 3.

    python3 tests/speed_against_mitsuba.py LIGHT_APART OUT [PATHS]

The pocket of scenes/corner, bare aluminium, its triangles divided until there are a million of them, at 2048 x 1088
pixels and up to three reflections. Both programs take turns, on all cores. The variance of a pixel falls as the time
grows, so their product says how long an image of the same noise takes. It is compared in squares of 8 x 8 pixels that
see no light reflected once, where both programs have the same to do. Mitsuba takes its scalar form: LLVM 14 and 15
cannot compile its metals. Prints medians. Asserts nothing: times depend on what else the machine does.
"""
import os
import sys
import time

import against_mitsuba as scenes
import mitsuba as mi
import numpy as np

import stl

REFLECTIONS = 3
ROUNDS = 3
CAMERA, TARGET = (0, -70, 170), (0, 0, -5)
TRIANGLES = 1e6
SIDE = 8
scenes.SIZE = (2048, 1088)
scenes.IMAGES = 4


def divided(triangles):
    """Each into as many of its shape."""
    sides = int(np.ceil((TRIANGLES / len(triangles)) ** 0.5))
    a, b, c = triangles.transpose(1, 0, 2)

    def at(i, j):
        return a + (b - a) * (i / sides) + (c - a) * (j / sides)

    places = [(i, j) for i in range(sides) for j in range(sides - i)]
    parts = [np.stack([at(i, j), at(i + 1, j), at(i, j + 1)], axis=1) for i, j in places]
    parts += [np.stack([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)], axis=1) for i, j in places if i + j < sides - 1]
    return np.concatenate(parts)


def squares(image):
    rows, columns = image.shape
    return image.reshape(rows // SIDE, SIDE, columns // SIDE, SIDE).sum(axis=(1, 3))


def noise(images):
    """Variance of single pixels, summed over squares."""
    return squares(np.var(images, axis=0, ddof=1))


def main():
    program, out = sys.argv[1:3]
    paths = int(sys.argv[3]) if len(sys.argv) > 3 else 1 << 20
    os.makedirs(out, exist_ok=True)
    mesh, part = [os.path.join(out, name) for name in ("part.ply", "part.stl")]
    triangles = divided(stl.read(os.path.join(scenes.HERE, "../scenes/corner/pocket.stl")).astype(float))
    scenes.ply(mesh, triangles)
    stl.write(part, triangles)
    surface, bsdf = scenes.metal(0.1)
    loaded = {}
    for variant in ("scalar_rgb",):
        mi.set_variant(variant)
        loaded[variant] = [scenes.their_scene(mesh, bsdf, CAMERA, TARGET, depth) for depth in (2, REFLECTIONS + 1)]
        for scene in loaded[variant]:
            scenes.theirs(scene, 1, 1000)
    seconds, ratios = [], {variant: [] for variant in loaded}
    for turn in range(ROUNDS):
        once, more, said = scenes.ours(program, out, part, surface, CAMERA, TARGET, REFLECTIONS, paths, 2)
        seconds += [[float(word) for word in line.split()] for line in said.splitlines()]
        direct, whole = np.median(seconds[-scenes.IMAGES:], axis=0)
        for variant, (alone, all_light) in loaded.items():
            mi.set_variant(variant)
            images, times = [], []
            for image in range(scenes.IMAGES):
                start = time.perf_counter()
                images.append(scenes.theirs(all_light, 1, 100 * turn + image))
                times.append(time.perf_counter() - start)
            images = np.array(images) / scenes.theirs(alone, 4, 0).sum()
            seen = squares(np.mean(more, axis=0))
            dark = squares(once) == 0
            lit = dark & (seen > 0.01 * seen[dark].max())
            ratio = noise(more)[lit] * (whole - direct) / (noise(images)[lit] * np.median(times))
            ratios[variant].append(np.quantile(ratio, [0.25, 0.5, 0.75]))
            print("%s: light of %.4f here, %.4f there; %.2f s of reflections here, %.2f s there; our time at equal noise %.3f "
                  "(quartiles of %d squares %.3f, %.3f)" % (
                      variant, seen[lit].sum(), squares(np.mean(images, axis=0))[lit].sum(), whole - direct, np.median(times),
                      ratios[variant][-1][1], lit.sum(), *ratios[variant][-1][::2]), flush=True)
    low, middle, high = np.quantile([whole / direct for direct, whole in seconds], [0.25, 0.5, 0.75])
    print("a frame with %d paths over its direct frame: %.1f (quartiles %.1f, %.1f), %.3f s" % (
        paths, middle, low, high, np.median(seconds, axis=0)[0]))
    for variant, found in ratios.items():
        print("over Mitsuba's time at equal noise, %s: %.3f" % (variant, np.median(found, axis=0)[1]))


main()
