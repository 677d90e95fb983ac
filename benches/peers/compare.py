"""Times both sides in turn and prints a table. Run by `run`."""

import json
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

import inputs
from chain import Chain

REPETITIONS = 9
DIRECTORY = Path("target/peers-data")
LOG_TAU = np.float32(np.log(2 * np.pi))


class Ours:
    """Our side: a process that does what it is told and says how long it took."""

    def __init__(self):
        command = ["cargo", "bench", "--quiet", "--bench", "ours", "--", str(DIRECTORY.resolve())]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, task):
        self.process.stdin.write(task + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            sys.exit(f"our side ended during `{task}`")
        return json.loads(line)


def timed(task, *arguments):
    """CPU seconds and result."""
    start = time.process_time()
    result = task(*arguments)
    return time.process_time() - start, result


def read(name, dtype, *shape):
    return np.fromfile(DIRECTORY / name, dtype).reshape(shape)


table = []


def row(what, unit, peer, peer_s, ours_s, note=""):
    """Medians over the repetitions; the ratio is the median of the ratios of neighbours in time."""
    scale = {"ms": 1e3, "s": 1.0}[unit]
    ratio = np.median(np.array(peer_s) / np.array(ours_s))
    table.append((what, peer, np.median(peer_s) * scale, np.median(ours_s) * scale, unit, ratio, note))
    print(f"{what}: {peer} {np.median(peer_s) * scale:.3f} {unit}, ours {np.median(ours_s) * scale:.3f} {unit}, "
          f"ratio {ratio:.2f}; {note}", flush=True)


def frames(ours, chain):
    jpegs = [path.read_bytes() for path in sorted((DIRECTORY / "frames").iterdir())]
    with_opencv = lambda: np.array([chain.properties(jpeg) for jpeg in jpegs])
    decode = lambda: [simplejpeg.decode_jpeg(jpeg, colorspace="GRAY") for jpeg in jpegs]
    opencv_s, turbo_s, ours_s, our_decode_s = [], [], [], []
    for _ in range(REPETITIONS + 1):
        seconds, theirs = timed(with_opencv)
        opencv_s.append(seconds / len(jpegs))
        answer = ours("chain")
        ours_s.append(answer["seconds"] / len(jpegs))
        turbo_s.append(timed(decode)[0] / len(jpegs))
        our_decode_s.append(ours("decode")["seconds"] / len(jpegs))
    opencv_s, turbo_s, ours_s, our_decode_s = (s[1:] for s in (opencv_s, turbo_s, ours_s, our_decode_s))  # warm-up
    properties = np.array(answer["properties"])
    share = lambda part: np.linalg.norm(properties[:, part] - theirs[:, part]) / np.linalg.norm(theirs[:, part])
    agree = ", ".join(f"{name} {100 * share(part):.2f} %" for name, part in
                      (("fft", slice(0, 128)), ("hist", slice(128, 284)), ("sp", slice(284, 356))))
    row("JPEG to 356 properties", "ms", "OpenCV + pyrtools", opencv_s, ours_s, f"differ by {agree}")
    row("the same, against a decode", "ms", "libjpeg-turbo, gray", turbo_s, ours_s, "peer only decodes")
    row("JPEG to luma", "ms", "libjpeg-turbo, gray", turbo_s, our_decode_s)


def fits(ours):
    positions = read("positions.f64", np.float64, -1, 2)
    features = read("features.f64", np.float64, len(positions), -1)
    extent = np.ptp(positions, axis=0)
    sizes = [tuple(5e-3 * extent), tuple(20 * extent)]

    def fit(z):
        # The same box and, as one would start it, lengths of 15 % of the extent.
        kernel = ConstantKernel(0.64, (1e-6, 1e4)) * RBF(0.15 * extent, list(zip(*sizes))) + WhiteKernel(
            0.25, (1e-6, 1e2))
        return GaussianProcessRegressor(kernel, n_restarts_optimizer=0).fit(positions, z).log_marginal_likelihood_value_

    warnings.simplefilter("ignore", ConvergenceWarning)
    ours("fit")
    ours_s, theirs, theirs_s = [], [], 0.0
    quarter = -(-features.shape[1] // 4)
    for start in range(0, features.shape[1], quarter):
        answer = ours("fit")
        ours_s.append(answer["seconds"])
        for z in features.T[start:start + quarter]:
            seconds, likelihood = timed(fit, z)
            theirs_s += seconds
            theirs.append(likelihood)
    found, theirs = np.array(answer["log_likelihood"]), np.array(theirs)
    row(f"GP fit, {features.shape[1]} features, n = {len(positions)}", "s", "scikit-learn", [theirs_s], [np.median(ours_s)],
        f"log-likelihood ours {found.sum():.1f}, theirs {theirs.sum():.1f}; {np.sum(found < theirs - 1e-3)} features less "
        f"likely by over 0.001, the worst by {max(0, np.max(theirs - found)):.4f}; "
        f"{answer['evaluations'] / len(found):.1f} evaluations a feature")
    return np.array(answer["hyperparameters"])


def predict(hyperparameters):
    """Posterior means and predictive variances on the cells, feature x cell."""
    positions, cells = read("positions.f64", np.float64, -1, 2), read("cells.f64", np.float64, -1, 2)
    features = read("features.f64", np.float64, len(positions), -1)
    mean, variance = [], []
    for (signal, noise, *lengths), z in zip(hyperparameters, features.T):
        def kernel(a, b):
            return signal**2 * np.exp(-0.5 * (((a[:, None] - b[None]) / lengths) ** 2).sum(2))
        factor = np.linalg.cholesky(kernel(positions, positions) + noise**2 * np.eye(len(positions)))
        c = np.linalg.solve(factor, kernel(positions, cells))
        mean.append(c.T @ np.linalg.solve(factor, z))
        variance.append(np.maximum(signal**2 - (c * c).sum(0), 0) + noise**2)
    return np.array(mean, np.float32), np.array(variance, np.float32)


def eliminate(table, cells, truth, dtype):
    """Backward elimination, one array operation a query and step: removed features and validation RMSE."""
    table = table.astype(dtype, copy=False)
    queries, features, _ = table.shape
    sums = table.sum(1)
    kept, removed, rmse = list(range(features)), [], []
    rmse.append(np.sqrt(np.mean(((cells[sums.argmax(1)] - truth) ** 2).sum(1))))
    buffer = np.empty(table.shape[1:], dtype)
    while len(kept) > 1:
        errors = np.zeros(len(kept))
        left = buffer[:len(kept)]
        for q in range(queries):
            np.subtract(sums[q], table[q, :len(kept)], out=left)
            errors += ((cells[left.argmax(1)] - truth[q]) ** 2).sum(1)
        worst = int(errors.argmin())
        sums -= table[:, worst]
        # What is left stays contiguous and in order.
        table[:, worst:len(kept) - 1] = table[:, worst + 1:len(kept)].copy()
        removed.append(kept.pop(worst))
        rmse.append(np.sqrt(errors.min() / queries))
    return removed + kept, rmse


def elimination(ours, mean, variance):
    cells, truth = read("cells.f64", np.float64, -1, 2), read("truth.f64", np.float64, -1, 2)
    validation = read("validation.f64", np.float64, len(truth), -1).astype(np.float32)
    table = np.empty((len(truth), *mean.shape), np.float32)
    for q, z in enumerate(validation):
        table[q] = -0.5 * ((z[:, None] - mean) ** 2 / variance + np.log(variance) + LOG_TAU)
    table.tofile(DIRECTORY / "table.f32")
    single_s, double_s, ours_s = [], [], []
    for _ in range(2):
        ours_s.append(ours("eliminate")["seconds"])
        single_s.append(timed(eliminate, table.copy(), cells, truth, np.float32)[0])
        answer = ours("eliminate")
        ours_s.append(answer["seconds"])
        copy = table.astype(np.float64)
        seconds, (removed, rmse) = timed(eliminate, copy, cells, truth, np.float64)
        double_s.append(seconds)
    same = next((i for i, (a, b) in enumerate(zip(removed, answer["removed"])) if a != b), len(removed))
    fastest, peer = min((np.median(single_s), "NumPy, float32"), (np.median(double_s), "NumPy, float64"))
    row(f"elimination, {len(mean)} x {len(truth)} x {len(cells)}", "s", peer, [fastest], [np.median(ours_s)],
        f"float32 {np.median(single_s):.2f} s, float64 {np.median(double_s):.2f} s; the first {same} of "
        f"{len(removed)} removals are those of float64, least RMSE {min(rmse):.4f} and {min(answer['rmse_m']):.4f} m")


def matching(ours, mean, variance):
    random = np.random.default_rng(1)
    rows = random.integers(0, len(mean), 356)
    mean = mean[rows] + random.normal(0, 0.1, (356, mean.shape[1])).astype(np.float32)
    variance = variance[rows]
    queries = mean[:, random.integers(0, mean.shape[1], 64)].T.copy()
    queries += random.normal(0, 0.5, queries.shape).astype(np.float32)
    for name, values in (("mean", mean), ("variance", variance), ("queries", queries)):
        values.tofile(DIRECTORY / f"match_{name}.f32")
    precision, normalizer = 1 / variance, -0.5 * (np.log(variance) + LOG_TAU).sum(0)
    weighted, constant = precision * mean, (precision * mean**2).sum(0)
    buffer = np.empty_like(mean)

    def direct():
        best = []
        for z in queries:
            np.subtract(z[:, None], mean, out=buffer)
            np.multiply(buffer, buffer, out=buffer)
            np.multiply(buffer, precision, out=buffer)
            best.append(int((normalizer - 0.5 * buffer.sum(0)).argmax()))
        return best

    def expanded():
        """The square multiplied out: two matrix-vector products, at the cost of digits."""
        return [int((normalizer - 0.5 * ((z * z) @ precision - 2 * (z @ weighted) + constant)).argmax()) for z in queries]

    direct_s, expanded_s, ours_s = [], [], []
    for _ in range(REPETITIONS):
        answer = ours("match")
        ours_s.append(answer["seconds"] / len(queries))
        seconds, best = timed(direct)
        direct_s.append(seconds / len(queries))
        expanded_s.append(timed(expanded)[0] / len(queries))
    agree = np.mean(np.array(best) == answer["best"])
    shape = f"matching, {len(mean)} x {mean.shape[1]}"
    row(shape, "ms", "NumPy, eq. 10", direct_s, ours_s, f"{100 * agree:.0f} % the same cell")
    row(shape, "ms", "NumPy, two BLAS products", expanded_s, ours_s)


def main():
    cv2.setNumThreads(1)
    data = os.environ.get("OMNILOC_DATA")
    data = Path(data) / "drive-378" if data else None
    donut = inputs.DONUT if data is None else json.loads((data / "donut.json").read_text())
    chain = Chain(donut)
    inputs.write(DIRECTORY, data, chain.properties)
    print(f"inputs: {data or 'generated'}", flush=True)
    ours = Ours()
    frames(ours, chain)
    hyperparameters = fits(ours)
    mean, variance = predict(hyperparameters)
    elimination(ours, mean, variance)
    matching(ours, mean, variance)
    print("\n| step | instead | takes | ours | ratio | |\n|---|---|---:|---:|---:|---|")
    for what, peer, peer_time, our_time, unit, ratio, note in table:
        print(f"| {what} | {peer} | {peer_time:.2f} {unit} | {our_time:.2f} {unit} | {ratio:.1f} | {note} |")


main()
