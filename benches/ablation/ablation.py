"""What every ingredient of the default recipe brings: the recipe again in NumPy, with one thing changed a row.

    python benches/ablation/ablation.py SURVEY OTHER_DAY... [--learn-every N] [--rows NAME,NAME] [--step-m M]

SURVEY and OTHER_DAY are data-set folders of one place, as `omniloc simulate --out` writes them. Learned from SURVEY (every
N-th image, at its true positions where it has truth.csv, so that receiver errors do not hide the differences), measured
on every frame of the other days. Needs numpy, scipy and opencv-python.
"""

import argparse
import csv
import json
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy.linalg import eigh

COLUMNS, ROWS = 512, 128
TAU = 2 * np.pi


def positions(folder):
    truth = folder / "truth.csv"
    rows = csv.DictReader(open(truth if truth.exists() else folder / "positions.csv"))
    return np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows])


def panoramas(folder):
    """n x 128 x 512, gray."""
    donut = json.loads((folder / "donut.json").read_text())
    turn = (np.arange(2 * COLUMNS) + 0.5) / (2 * COLUMNS) * TAU
    azimuth = donut["start_angle"] + (turn if donut["clockwise"] else -turn)
    depth = (np.arange(2 * ROWS) + 0.5) / (2 * ROWS) * (donut["r_out"] - donut["r_in"])
    radius = (donut["r_out"] - depth if donut["top_is_outer"] else donut["r_in"] + depth)[:, None]
    x = (donut["cx"] + radius * np.cos(azimuth)).astype(np.float32)
    y = (donut["cy"] + radius * np.sin(azimuth)).astype(np.float32)
    for row in csv.DictReader(open(folder / "positions.csv")):
        gray = cv2.imread(str(folder / "images" / Path(row["file"]).name), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        yield cv2.resize(cv2.remap(gray, x, y, cv2.INTER_LINEAR), (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)


def perturbed(panorama, random):
    """The place on another day, guessed: src/train/perturbation.rs."""
    azimuth = np.arange(COLUMNS) / COLUMNS * TAU
    shift = random.uniform(0, 1.5) * np.cos(azimuth - random.uniform(0, TAU))
    column, row = np.meshgrid(np.arange(COLUMNS, dtype=np.float32), np.arange(ROWS, dtype=np.float32))
    x = cv2.remap(panorama, column, (row + shift).astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    x = 255 * (x.clip(0, 255) / 255) ** np.exp(random.normal(0, 0.25))
    light = random.normal(0, 0.3) + random.normal(0, 0.3) * np.cos(azimuth - random.uniform(0, TAU))
    light = light + random.normal(0, 0.15) * np.cos(2 * azimuth - random.uniform(0, TAU))
    light = light[None] + random.normal(0, 0.3) * (np.arange(ROWS) / ROWS - 0.5)[:, None]
    for _ in range(random.integers(0, 4)):
        width, height = random.integers(15, 120), random.integers(15, 60)
        left, top = random.integers(COLUMNS), random.integers(0, ROWS - height)
        skew, strength = random.uniform(-1, 1), random.uniform(-0.7, 0.5)
        for i in range(height):
            light[top + i, (np.arange(width) + left + int(skew * i)) % COLUMNS] += strength
    x = x * np.exp(light)
    for _ in range(random.integers(0, 4)):
        width, height = random.integers(6, 50), random.integers(10, 40)
        left, top = random.integers(COLUMNS), int(random.uniform(0.35 * ROWS, 0.9 * ROWS - height / 2))
        x[top : top + height, (np.arange(width) + left) % COLUMNS] = random.uniform(10, 200)
        if height > 16:
            roof = (np.arange(width * 2 // 3) + left + width // 6) % COLUMNS
            x[top : top + height // 3, roof] = random.uniform(10, 200)
    return (x + random.normal(0, 2, x.shape)).clip(0, 255).astype(np.float32)


def blurred(x, sigma):
    radius = int(np.ceil(3 * sigma))
    wrapped = cv2.copyMakeBorder(x, 0, 0, radius, radius, cv2.BORDER_WRAP)
    size = (2 * radius + 1, 2 * radius + 1)
    return cv2.GaussianBlur(wrapped, size, sigma, borderType=cv2.BORDER_REPLICATE)[:, radius:-radius]


def reduced(panorama, factor):
    return cv2.resize(panorama, (COLUMNS // factor, ROWS // factor), interpolation=cv2.INTER_AREA)


def orientations(panorama, masked, factor, blur, contrast, bands):
    """h_b(e, a) of src/features/gradient.rs: 12 x band x column; nothing in the thirty-seconds `masked` of the rows."""
    log = blurred(np.log(reduced(panorama, factor) + 16), blur)
    rows, columns = log.shape
    east = 0.5 * (np.roll(log, -1, 1) - np.roll(log, 1, 1))
    padded = np.pad(log, ((1, 1), (0, 0)), "edge")
    down = 0.5 * (padded[2:] - padded[:-2])
    norm, direction = cv2.cartToPolar(east, down)
    weight = norm / (blurred(norm, contrast) + 0.05)
    turn = direction * (12 / TAU)
    lower = turn.astype(int)
    share = turn - lower
    at = (np.arange(rows) * bands // rows)[:, None] * columns + np.arange(columns)
    size = bands * columns
    bins = np.bincount((lower % 12 * size + at).ravel(), (weight * (1 - share)).ravel(), 12 * size)
    bins += np.bincount(((lower + 1) % 12 * size + at).ravel(), (weight * share).ravel(), 12 * size)
    bins = bins.reshape(12, bands, columns) / (rows // bands)
    bins[:, masked.start * bands // 32 : masked.stop * bands // 32] = 0
    return bins


def gradients(*sizes):
    """src/features/gradient.rs before the magnitudes: bin x band x harmonic."""

    def describe(panorama, masked):
        bins = orientations(panorama, masked, *sizes)
        return np.fft.rfft(bins, axis=2)[:, :, :13] / bins.shape[2]

    return describe


def waves():
    """Orthonormal waves of a patch, 16 cells x 12 orientations, by 30."""
    cosine = lambda u: np.sqrt((2 if u else 1) / 4) * np.cos(np.pi * (np.arange(4) + 0.5) * u / 4)
    turn = TAU * np.arange(12) / 12
    around = [(0, np.full(12, np.sqrt(1 / 12)))]
    for m in (1, 2, 3):
        around += [(m, np.sqrt(2 / 12) * np.cos(m * turn)), (m, np.sqrt(2 / 12) * np.sin(m * turn))]
    orders = [(u, v, m, wave) for u in range(4) for v in range(4) for m, wave in around if u + v + m <= 3]
    return np.array([np.einsum("i,j,b->ijb", cosine(u), cosine(v), wave).ravel() for u, v, _, wave in orders]).T


def patches(panorama, masked=slice(0, 0)):
    """src/features/patches.rs: 416 x 31."""
    cells = orientations(panorama, masked, 2, 1.0, 8.0, 32).reshape(12, 16, 2, 64, 4).mean((2, 4))
    cells = 0.25 * np.roll(cells, 1, 2) + 0.5 * cells + 0.25 * np.roll(cells, -1, 2)
    rows, columns = np.arange(13), np.arange(0, 64, 2)
    parts = [cells[:, rows[:, None] + i, (columns + j) % 64] for i in range(4) for j in range(4)]
    parts = np.concatenate(parts).reshape(192, -1)
    coefficients = np.sqrt(parts / (parts.sum(0) + 16 * 0.3)).T @ waves()
    return np.column_stack([coefficients, np.repeat(rows / 12 - 0.5, 32)]).astype(np.float32)


FREQUENCIES = np.random.default_rng(0).standard_normal((31, 1024)).astype(np.float32) / 0.35
PHASES = np.random.default_rng(1).uniform(0, TAU, 1024).astype(np.float32)
WORDS = Path(__file__).parents[2] / "src/features/words.bin"


def kernel_mean(x):
    return np.cos(x @ FREQUENCIES + PHASES).mean(0)


def patch_words(x):
    """src/features/words.rs."""
    words = np.fromfile(WORDS, np.int8).reshape(-1, 31).astype(np.float32) / 128
    square = (words**2).sum(1) - 2 * x @ words.T
    share = np.exp(-60 * (square - square.min(1, keepdims=True)))
    share /= share.sum(1, keepdims=True)
    residual = share.T @ x - share.sum(0)[:, None] * words
    residual /= np.linalg.norm(residual, axis=1, keepdims=True) + 0.01
    return residual.ravel() / np.sqrt(len(words))


def row_fourier(panorama, _):
    """Menegatti, Maeda & Ishiguro (2004) on log gray: 1 x 32 x harmonic."""
    rows = np.log(reduced(panorama, 2) + 16).reshape(32, 2, -1).mean(1)
    return np.fft.rfft(rows, axis=1)[None, :, :13] / rows.shape[1]


def census(panorama, _):
    """Shares of brighter and darker neighbours in eight directions a ring: 8 x 32 x harmonic."""
    log = np.log(blurred(reduced(panorama, 2), 1.0) + 16)
    padded, planes = np.pad(log, ((0, 2), (0, 0)), "edge"), []
    for down, east in ((0, 2), (2, 2), (2, 0), (2, -2)):
        other = np.roll(padded[down : down + len(log)], -east, 1)
        planes += [(other > log + 0.03), (other < log - 0.03)]
    return np.fft.rfft(np.array(planes, float).reshape(8, 32, 2, -1).mean(2), axis=2)[:, :, :13] / log.shape[1]


PLANES = {
    "fine": gradients(2, 1.0, 8.0, 32),
    "coarse": gradients(4, 1.5, 4.0, 16),
    "rows": row_fourier,
    "census": census,
    "patches": lambda panorama, masked: kernel_mean(patches(panorama, masked)),
    "patch-words": lambda panorama, masked: patch_words(patches(panorama, masked)),
}
# Feature type: planes, opposite bins added, harmonics.
SIGNATURES = {
    "gradient": ("fine", True, 5),
    "gradient-signed": ("fine", False, 5),
    "gradient-coarse": ("coarse", False, 5),
    "row-fourier": ("rows", False, 13),
    "census": ("census", False, 9),
}
DEFAULT = ("gradient", "patches", "patch-words")
# Added to the noise, as a share of its mean eigenvalue.
RIDGE = {"patch-words": 2.0}


def signature(planes, name, harmonics):
    if name not in SIGNATURES:
        return planes[name]
    plane, unsigned, default_harmonics = SIGNATURES[name]
    spectrum = planes[plane]
    if unsigned:
        spectrum = spectrum[..., :6, :, :] + spectrum[..., 6:, :, :]
    root = np.sqrt(np.abs(spectrum[..., : harmonics or default_harmonics])).reshape(*spectrum.shape[:-3], -1)
    return root / np.linalg.norm(root, axis=-1, keepdims=True)


def squared_m2(a, b):
    return ((a[:, None] - b[None]) ** 2).sum(2)


def spacing_m(at):
    squared = squared_m2(at, at)
    np.fill_diagonal(squared, np.inf)
    return np.sqrt(np.median(squared.min(1)))


def kernel(squared, length_m, name):
    if name == "matern-3/2":
        scaled = np.sqrt(3 * squared) / length_m
        return (1 + scaled) * np.exp(-scaled)
    return np.exp(-0.5 * squared / length_m**2)


# How much of eq. 10's log variance an unknown scale of the residuals is charged. None is left when the residuals are
# divided by the variance too.
NOT_KNOWING = {"unknown-scale": 0.5, "fully charged": 1.0, "scaled-variance": 0.0}


class Group:
    """src/train/noise_whitening.rs and the Gaussian processes of the features it finds, on the cells."""

    def __init__(self, properties, changes, at, cells, o, ridge=0.05):
        n, self.mean = len(at), properties.mean(0)
        u, d, vt = np.linalg.svd(properties - self.mean, full_matrices=False)
        rank = int((d > 1e-5 * d[0]).sum())
        basis, z = vt[:rank].T, u[:, :rank] * d[:rank]
        length_m = o["length"] * spacing_m(at)
        values, vectors = np.linalg.eigh(kernel(squared_m2(at, at), length_m, o["kernel"]))
        tried = []
        for q in 2.0 ** np.arange(-10, 3, 0.5):
            inverse = (vectors / (values.clip(0) + q)) @ vectors.T
            residual = (inverse @ z) / np.diag(inverse)[:, None]
            tried.append(((residual**2).sum(), q, inverse, residual))
        _, q, inverse, residual = min(tried, key=lambda one: one[0])
        noise = residual.T @ residual / n
        if o["perturbations"]:
            projected = changes @ basis
            noise += projected.T @ projected / len(projected)
        noise += ridge * np.trace(noise) / rank * np.eye(rank)
        strength, directions = eigh(z.T @ z / n, noise)
        directions = directions[:, np.argsort(-strength)[: o["features"]]]
        self.projection = basis @ directions
        across = kernel(squared_m2(cells, at), length_m, o["kernel"])
        self.field = across @ (inverse @ (z @ directions))
        self.variance = (q + 1 - np.einsum("ij,ij->i", across @ inverse, across)) / np.mean(1 / np.diag(inverse))
        self.noise = o["noise"]

    def log_likelihood(self, properties):
        features = (properties - self.mean) @ self.projection
        k = features.shape[1]
        square = (features**2).sum(1)[:, None] - 2 * features @ self.field.T + (self.field**2).sum(1)
        square = square.clip(1e-9)
        if self.noise == "gaussian":
            return -0.5 * square / self.variance - 0.5 * k * np.log(self.variance)
        return -0.5 * k * (np.log(square) + NOT_KNOWING[self.noise] * np.log(self.variance))


def locate(log_likelihood, cells, columns, step_m):
    """The summit of parabolas through the best cell and its neighbours."""
    found = []
    for row in log_likelihood:
        best = row.argmax()
        j, i = divmod(best, columns)
        table, at = row.reshape(-1, columns), cells[best].copy()
        for axis, (index, line) in enumerate(((i, table[j]), (j, table[:, i]))):
            if 0 < index < len(line) - 1:
                before, peak, after = line[index - 1 : index + 2]
                curvature = before - 2 * peak + after
                at[axis] += step_m * np.clip(0.5 * (before - after) / curvature, -0.5, 0.5) if curvature < 0 else 0
        found.append(at)
    return np.array(found)


ROW = dict(signatures=DEFAULT, harmonics=None, prepared="as it is", features=192, length=1.5, kernel="gaussian",
           perturbations=True, noise="unknown-scale")
TABLE = {
    "default": {},
    "residual divided by the variance": dict(noise="scaled-variance"),
    "all of eq. 10's log variance": dict(noise="fully charged"),
    "eq. 10": dict(noise="gaussian"),
    "no perturbations": dict(perturbations=False),
    **{f"{name} alone": dict(signatures=(name,)) for name in (*SIGNATURES, "patches", "patch-words")},
    **{f"without {one}": dict(signatures=tuple(name for name in DEFAULT if name != one)) for one in DEFAULT},
    "with gradient-signed": dict(signatures=(*DEFAULT, "gradient-signed")),
    "with gradient-coarse": dict(signatures=(*DEFAULT, "gradient-coarse")),
    "with both": dict(signatures=(*DEFAULT, "gradient-signed", "gradient-coarse")),
    "with both, 96 features": dict(signatures=(*DEFAULT, "gradient-signed", "gradient-coarse"), features=96),
    "with row-fourier": dict(signatures=(*DEFAULT, "row-fourier")),
    "with census": dict(signatures=(*DEFAULT, "census")),
    "3 harmonics": dict(harmonics=3),
    "9 harmonics": dict(harmonics=9),
    "without the upper eighth of the rows": dict(prepared="upper eighth masked"),
    "without the lower eighth of the rows": dict(prepared="lower eighth masked"),
    "one mean and deviation of the gray values": dict(prepared="one mean and deviation"),
    "48 features": dict(features=48),
    "96 features": dict(features=96),
    "300 features": dict(features=300),
    "length 1.0": dict(length=1.0),
    "length 1.75": dict(length=1.75),
    "matern-3/2, length 3": dict(kernel="matern-3/2", length=3.0),
    "nearest learning image": None,
}


def evened(panorama):
    """The whole panorama brought to one mean and deviation."""
    return (128 + 48 * (panorama - panorama.mean()) / (panorama.std() + 1)).clip(0, 255)


# What is done to a panorama, perturbed or not, before it is described, and which thirty-seconds of its rows are masked.
PREPARED = {
    "as it is": (lambda panorama: panorama, slice(0, 0)),
    "upper eighth masked": (lambda panorama: panorama, slice(0, 4)),
    "lower eighth masked": (lambda panorama: panorama, slice(28, 32)),
    "one mean and deviation": (evened, slice(0, 0)),
}


@cache
def described(folder, copies, prepared):
    """Planes of all frames, and of `copies` perturbed copies of each: n x copies."""
    prepare, masked = PREPARED[prepared]
    clean, other = {name: [] for name in PLANES}, {name: [] for name in PLANES}
    for number, panorama in enumerate(panoramas(folder)):
        again = [perturbed(panorama, np.random.default_rng([number, copy])) for copy in range(copies)]
        for name, describe in PLANES.items():
            clean[name].append(describe(prepare(panorama), masked))
            other[name].append([describe(prepare(one), masked) for one in again])
    return {k: np.array(v) for k, v in clean.items()}, {k: np.array(v) for k, v in other.items()}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("other_days", type=Path, nargs="+")
    parser.add_argument("--learn-every", type=int, default=1)
    parser.add_argument("--step-m", type=float, default=1.0)
    parser.add_argument("--rows", default=",".join(TABLE))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    every = slice(None, None, args.learn_every)
    at = positions(args.survey)[every]
    low, high = at.min(0), at.max(0)
    columns, rows = (np.floor((high - low) / args.step_m + 1e-9) + 1).astype(int)
    grid = np.meshgrid(low[0] + args.step_m * np.arange(columns), low[1] + args.step_m * np.arange(rows))
    cells = np.stack(grid, -1).reshape(-1, 2)
    print(f"{len(at)} learning images, median spacing {spacing_m(at):.2f} m; mean over {len(args.other_days)} days")
    print(f"{'row':38} {'RMSE':>7} {'median':>7} {'P95':>7} {'>10 m':>7}")
    for name in args.rows.split(","):
        o = {**ROW, **(TABLE[name] or {})}
        of = lambda planes: [signature(planes, one, o["harmonics"]) for one in o["signatures"]]
        clean, again = described(args.survey, 2, o["prepared"])
        learned = [one[every] for one in of(clean)]
        groups = [] if TABLE[name] is None else [
            Group(here, (there[every] - here[:, None]).reshape(-1, here.shape[1]), at, cells, o, RIDGE.get(name, 0.05))
            for name, here, there in zip(o["signatures"], learned, of(again))
        ]
        figures = []
        for folder in args.other_days:
            truth, seen = positions(folder), of(described(folder, 0, o["prepared"])[0])
            if groups:
                total = sum(group.log_likelihood(one) for group, one in zip(groups, seen))
                found = locate(total, cells, columns, args.step_m)
            else:
                found = at[sum(one @ here.T for one, here in zip(seen, learned)).argmax(1)]
            error = np.linalg.norm(found - truth, axis=1)
            figures.append([np.sqrt((error**2).mean()), np.median(error), np.percentile(error, 95), (error > 10).mean()])
        rmse, median, p95, over = np.mean(figures, 0)
        print(f"{name:38} {rmse:7.3f} {median:7.3f} {p95:7.2f} {100 * over:6.1f}%", flush=True)


if __name__ == "__main__":
    main()
