"""Reads a map with safetensors and NumPy alone: checksum, shapes, and the posterior mean from its own training data."""

import hashlib
import json
import sys

import numpy as np
from safetensors import safe_open

with safe_open(sys.argv[1], framework="numpy") as file:
    text = file.metadata()["omniloc"]
    tensors = {name: file.get_tensor(name) for name in file.keys()}

checksum = hashlib.sha256(text.encode())
for name in sorted(set(tensors) - {"sha256"}):
    checksum.update(name.encode())
    checksum.update(tensors[name].tobytes())
assert checksum.digest() == tensors["sha256"].tobytes(), "the checksum fits"

info = json.loads(text)
assert info["format_version"] == 2
positions_m, cells = tensors["positions_m"], tensors["cells"]
grid = info["grid"]
centers_m = np.array(grid["origin_m"]) + grid["step_m"] * cells
assert len(info["groups"]) > 0
for group in info["groups"]:
    name = group["recipe"]["descriptor"]
    learning = tensors[f"{name}/learning"]
    assert learning.shape == (len(positions_m), group["features"])
    shared = group["hyperparameters"]["shared"]
    lengths_m = np.array(shared["length_scale_m"])

    def kernel(a, b):
        r2 = (((a[:, None] - b[None]) / lengths_m) ** 2).sum(2)
        return shared["signal_std"] ** 2 * np.exp(-0.5 * r2)

    noise = shared["noise_std"] ** 2 * np.eye(len(positions_m))
    r = kernel(positions_m, positions_m) + noise
    c = kernel(centers_m, positions_m)
    mean = (c @ np.linalg.solve(r, learning)).T
    variance = shared["signal_std"] ** 2 - (c * np.linalg.solve(r, c.T).T).sum(1) + shared["noise_std"] ** 2
    np.testing.assert_allclose(tensors[f"{name}/field_mean"], mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(tensors[f"{name}/field_variance"][0], variance, rtol=1e-4)
print(f"{len(info['groups'])} groups, {len(positions_m)} learning positions, {len(cells)} cells")
