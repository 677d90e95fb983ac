"""The inputs of the comparison: frames, features, likelihoods. From a data set, or generated."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np

FRAMES = 24
FEATURES = 128
LEARNING, QUERIES = 189, 94
CELLS = (55, 79)  # 4345
DONUT = {"kind": "donut", "cx": 651.0, "cy": 352.0, "r_in": 115.0, "r_out": 335.0, "top_is_outer": True,
         "start_angle": 0.0, "clockwise": True, "azimuth": "ccw"}


def generated_frames(random):
    """Textured donuts 1280 x 720 on a dark surround, quality 85: detail of several sizes, every frame another."""
    y, x = np.mgrid[0:720, 0:1280]
    radius = np.hypot(x - DONUT["cx"], y - DONUT["cy"])
    inside = (radius > DONUT["r_in"]) & (radius < DONUT["r_out"])
    for _ in range(FRAMES):
        image = np.full((720, 1280, 3), 110.0)
        for size, strength in ((6, 40), (24, 25), (96, 12), (360, 4)):
            coarse = random.normal(0, strength, (2 * size, 3 * size, 3)).astype(np.float32)
            image += cv2.resize(coarse, (1280, 720), interpolation=cv2.INTER_CUBIC)
        image += random.normal(0, 2, image.shape)
        image[~inside] = 8 + random.normal(0, 2, image.shape)[~inside]
        _, jpeg = cv2.imencode(".jpg", np.clip(image, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 85])
        yield jpeg.tobytes()


def generated_survey(random):
    """Positions along a winding drive and features that vary over metres to tens of metres, with noise."""
    n = LEARNING + 2 * QUERIES
    turn = np.linspace(0, 4 * np.pi, n)
    positions = np.stack([27 + 25 * np.sin(turn), 39 + 37 * np.sin(1.5 * turn + 0.3)], 1)
    positions += random.normal(0, 0.6, positions.shape)
    features = np.empty((n, FEATURES))
    for r in range(FEATURES):
        length = np.exp(random.uniform(np.log(2), np.log(30), 2))
        waves = random.normal(size=(60, 2)) / length
        field = np.cos(positions @ waves.T + random.uniform(0, 2 * np.pi, 60)).sum(1) * np.sqrt(2 / 60)
        share = random.uniform(0.05, 0.95)
        features[:, r] = np.sqrt(share) * field + np.sqrt(1 - share) * random.normal(size=n)
    order = random.permutation(n)
    return positions, features, np.sort(order[:LEARNING]), np.sort(order[LEARNING:LEARNING + QUERIES])


def survey_of(data, properties_of):
    """Positions, whitened fft features, and the learning and validation rows of `data`'s split."""
    rows = list(csv.DictReader(open(data / "positions.csv")))
    positions = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows])
    of_index = {row["index"]: row["set"] for row in csv.DictReader(open(data / "split-0.csv"))}
    sets = np.array([of_index.get(row["index"]) for row in rows])
    learning, validation = np.flatnonzero(sets == "learning"), np.flatnonzero(sets == "validation")
    y = np.array([properties_of(path.read_bytes())[:128] for path in frames_of(data, rows)])
    centered = y - y[learning].mean(0)
    _, s, vt = np.linalg.svd(centered[learning], full_matrices=False)
    features = centered @ (vt / (s[:, None] / np.sqrt(len(learning) - 1))).T
    return positions, features, learning, validation


def frames_of(data, rows):
    return [data / "images" / Path(row["file"]).name for row in rows]


def write(directory, data, properties_of):
    """Writes what both sides read; `data` is a data set's folder or None."""
    random = np.random.default_rng(378)
    (directory / "frames").mkdir(parents=True, exist_ok=True)
    for old in (directory / "frames").iterdir():
        old.unlink()
    donut = DONUT if data is None else json.loads((data / "donut.json").read_text())
    (directory / "donut.json").write_text(json.dumps(donut))
    if data is None:
        frames = generated_frames(random)
        survey = generated_survey(random)
    else:
        rows = list(csv.DictReader(open(data / "positions.csv")))
        frames = [path.read_bytes() for path in frames_of(data, rows)[:: max(1, len(rows) // FRAMES)]]
        survey = survey_of(data, properties_of)
    for i, jpeg in enumerate(frames):
        (directory / "frames" / f"{i:03}.jpg").write_bytes(jpeg)
    positions, features, learning, validation = survey
    positions[learning].tofile(directory / "positions.f64")
    features[learning].tofile(directory / "features.f64")
    positions[validation].tofile(directory / "truth.f64")
    features[validation].tofile(directory / "validation.f64")
    low, high = positions[learning].min(0), positions[learning].max(0)
    columns, rows = CELLS
    x, y = np.meshgrid(np.linspace(low[0], high[0], columns), np.linspace(low[1], high[1], rows))
    np.stack([x.ravel(), y.ravel()], 1).tofile(directory / "cells.f64")
