"""SURF of a gray image with what mahotas has of it: its determinants and its descriptors.

surf.py IMAGE WIDTH THRESHOLD: IMAGE holds the pixels, one byte each. Prints a JSON list of points: x, y, scale, orientation
and descriptor, in the conventions of Bay et al. (2008).

The maxima of the determinants are found here: mahotas 1.4 takes the step to the summit of a maximum with the wrong sign, and
the gradient's axes in another order than the Hessian's, which moves points by up to a pixel and drops others.
"""

import json
import sys

import numpy as np
from mahotas.features import _surf, surf

OCTAVES, LAYERS = 3, 4


def summits(determinants, octave):
    """x, y, scale, determinant of the local maxima of one octave, layer x row x column."""
    # Further in than mahotas fills in. Negative determinants are zeros.
    border = 3 * (2 ** (octave + 1) * (LAYERS + 1) + 1) // 2 + 2
    _, rows, columns = determinants.shape
    found = []
    for layer, row, column in np.argwhere(determinants > threshold):
        if not (0 < layer < LAYERS - 1 and border < row < rows - border and border < column < columns - border):
            continue
        near = determinants[layer - 1:layer + 2, row - 1:row + 2, column - 1:column + 2]
        if (near >= near[1, 1, 1]).sum() > 1:
            continue
        # A quadric through the 27 values: the step to its summit, in layers, rows and columns.
        gradient = [0.5 * (near[2, 1, 1] - near[0, 1, 1]), 0.5 * (near[1, 2, 1] - near[1, 0, 1]),
                    0.5 * (near[1, 1, 2] - near[1, 1, 0])]
        hessian = np.empty((3, 3))
        for i in range(3):
            for j in range(3):
                a, b = np.eye(3, dtype=int)[[i, j]]
                at = lambda d: near[tuple(1 + d)]
                hessian[i, j] = at(a) + at(-a) - 2 * at(0 * a) if i == j else \
                    (at(a + b) + at(-a - b) - at(a - b) - at(b - a)) / 4
        step = -np.linalg.solve(hessian, gradient)
        if (abs(step) <= 0.5).all():
            lobe = 2 ** (octave + 1) * (layer + 1 + step[0]) + 1
            y, x = np.multiply(2**octave, [row + step[1], column + step[2]])
            found.append([y, x, 0.4 * lobe, near[1, 1, 1], 1.0])
    return found


path, width, threshold = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
integral = surf.integral(np.fromfile(path, np.uint8).reshape(-1, width).astype(np.float64))
pyramid = _surf.pyramid(integral, OCTAVES, LAYERS, 1)
blobs = np.array([blob for octave in range(OCTAVES) for blob in summits(abs(pyramid[octave]), octave)])
points = []
for y, x, scale, _, _, angle, *numbers in surf.descriptors(integral, blobs, is_integral=True):
    # mahotas counts its angle from the y axis and takes left minus right: against the gradient. Along its y axis it has our
    # x axis reversed, and its x axis is our y axis; the sums of a region come in the order of its axes.
    along_y, along_x, abs_y, abs_x = np.array(numbers).reshape(4, 4, 4).transpose(2, 0, 1)
    regions = np.stack([along_y, -along_x, abs_y, abs_x], axis=-1)
    # Its regions run along its y axis first, then along its x axis; ours along our y axis, then our x axis.
    ours = regions[::-1].transpose(1, 0, 2)
    points.append({
        "x": x, "y": y, "scale": scale,
        "orientation": float(np.arctan2(-np.cos(angle), -np.sin(angle))),
        "descriptor": ours.ravel().tolist(),
    })
json.dump(points, sys.stdout)
