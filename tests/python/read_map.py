"""Reads a map with safetensors and NumPy alone: checksums, shapes, and the posterior from its own training data."""

import hashlib
import json
import sys
import zlib

import numpy as np
from safetensors import safe_open

with safe_open(sys.argv[1], framework="numpy") as file:
    text = file.metadata()["omniloc"]
    tensors = {name: file.get_tensor(name) for name in file.keys()}

checksum = hashlib.sha256(text.encode())
for name in sorted(set(tensors) - {"sha256"} - {name.removesuffix("/crc32") for name in tensors if "/crc32" in name}):
    checksum.update(name.encode())
    checksum.update(tensors[name].tobytes())
assert checksum.digest() == tensors["sha256"].tobytes(), "the checksum fits"

info = json.loads(text)
assert info["format_version"] == 5
positions_m, cells = tensors["positions_m"], tensors["cells"]
grid = info["grid"]
centers_m = np.array(grid["origin_m"]) + grid["step_m"] * cells
assert len(info["groups"]) > 0

# From blocks to a mean and a variance, feature x cell, for every group.
BLOCK_SIDE = 16
rows = [count for group in info["groups"] for count in (group["features"], 1)]
fields = [np.empty((count, len(cells)), np.float32) for count in rows]
corners, block_of = np.unique(cells[:, ::-1] // BLOCK_SIDE, axis=0, return_inverse=True)
at = 0
for block in range(len(corners)):
    begin, inside = at, np.flatnonzero(block_of.ravel() == block)
    for field in fields:
        end = at + len(field) * len(inside)
        field[:, inside] = tensors["fields"][at:end].reshape(len(field), len(inside))
        at = end
    assert zlib.crc32(tensors["fields"][begin:at].tobytes()) == tensors["fields/crc32"][block]
assert at == len(tensors["fields"])

for number, group in enumerate(info["groups"]):
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
    assert zlib.crc32(learning.tobytes()) == tensors[f"{name}/learning/crc32"][0]
    np.testing.assert_allclose(fields[2 * number], mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(fields[2 * number + 1][0], variance, rtol=1e-4)
print(f"{len(info['groups'])} groups, {len(positions_m)} learning positions, {len(cells)} cells")
