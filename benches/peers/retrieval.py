"""What one would take instead of a map of Gaussian processes: the position of the most similar learning image.

Two measures of similarity, each with the settings that were best on places that are not reported (`days --tune`):

- aligned retrieval: the largest circular correlation of small panoramas over all turns, as in visual-compass and
  route-following work (Zeil, Hofmann & Chahl 2003; Milford & Wyeth 2012 normalise patches the same way);
- SIFT-VLAD: RootSIFT (Arandjelovic & Zisserman 2012) in vectors of locally aggregated descriptors (Jegou et al. 2010),
  64 words learned on the map's images, every word's residuals normalised by themselves (Arandjelovic & Zisserman 2013).
"""

import json
from pathlib import Path

import cv2
import numpy as np

WIDE = (1024, 256)
SMALL = (128, 32)
WORDS = 64
# Descriptors that the words are learned from.
SAMPLE = 30_000


class Lens:
    """JPEG of a donut -> 1024 x 256 panorama, bilinear."""

    def __init__(self, donut):
        azimuth = (np.arange(WIDE[0]) + 0.5) / WIDE[0] * 2 * np.pi
        angle = donut["start_angle"] + (azimuth if donut["clockwise"] else -azimuth)
        inwards = (np.arange(WIDE[1]) + 0.5) / WIDE[1]
        inwards = inwards if donut["top_is_outer"] else 1 - inwards
        radius = (donut["r_out"] - (donut["r_out"] - donut["r_in"]) * inwards)[:, None]
        self.x = (donut["cx"] + radius * np.cos(angle)).astype(np.float32)
        self.y = (donut["cy"] + radius * np.sin(angle)).astype(np.float32)

    @classmethod
    def of(cls, dataset):
        return cls(json.loads((Path(dataset) / "donut.json").read_text()))

    def panorama(self, path):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        return cv2.remap(image, self.x, self.y, cv2.INTER_LINEAR)


def around(image, margin):
    """The panorama with `margin` columns of its other end on either side."""
    return np.concatenate([image[:, -margin:], image, image[:, :margin]], axis=1)


class Aligned:
    """Nearest image by the largest circular correlation. `scale` is the deviation of the Gaussian window in which mean
    and contrast are evened out, in columns of the small panorama; None: over the whole image."""

    def __init__(self, size=SMALL, scale=None):
        self.size, self.scale = size, scale
        self.settings = f"aligned {size} {scale}"

    def describe(self, panorama):
        small = cv2.resize(panorama.astype(np.float32), self.size, interpolation=cv2.INTER_AREA)
        if self.scale is not None:
            margin = int(3 * self.scale) + 1
            wide = around(small, margin)
            blur = lambda image: cv2.GaussianBlur(image, (0, 0), self.scale, borderType=cv2.BORDER_REPLICATE)
            mean = blur(wide)
            deviation = np.sqrt(np.maximum(blur(wide * wide) - mean * mean, 0))
            small = ((wide - mean) / (deviation + 4))[:, margin:-margin]
        small = small - small.mean()
        return np.fft.rfft(small / (np.linalg.norm(small) + 1e-9), axis=1).astype(np.complex64)

    def learn(self, learning):
        self.learning = np.conj(np.array(learning))

    def nearest(self, query):
        correlation = np.fft.irfft(np.einsum("lrk,rk->lk", self.learning, query), self.size[0], axis=1)
        return int(correlation.max(1).argmax())


class SiftVlad:
    """Nearest image by VLAD of RootSIFT. `upright`: orientations are not taken from the image; the panorama has an up."""

    def __init__(self, size=(512, 128), upright=False, contrast=0.04):
        self.size, self.upright = size, upright
        self.settings = f"sift-vlad {size} {upright} {contrast}"
        self.sift = cv2.SIFT_create(contrastThreshold=contrast)

    def describe(self, panorama):
        """RootSIFT of all points; those at the seam are found once, on the panorama continued beyond it."""
        image = cv2.resize(panorama, self.size, interpolation=cv2.INTER_AREA)
        margin = self.size[0] // 16
        wide = around(image, margin)
        points = self.sift.detect(wide, None)
        points = [point for point in points if margin <= point.pt[0] < margin + self.size[0]]
        if self.upright:
            for point in points:
                point.angle = 0.0
            # Points that differed by their orientation alone.
            points = list({(point.pt, point.size): point for point in points}.values())
        if not points:
            return np.zeros((0, 128), np.float16)
        _, descriptors = self.sift.compute(wide, points)
        descriptors /= descriptors.sum(1, keepdims=True) + 1e-9
        return np.sqrt(descriptors).astype(np.float16)

    def learn(self, learning):
        everything = np.concatenate(learning).astype(np.float32)
        random = np.random.default_rng(0)
        sample = everything[random.permutation(len(everything))[:SAMPLE]]
        cv2.setRNGSeed(0)
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
        _, _, self.words = cv2.kmeans(sample, WORDS, None, criteria, 1, cv2.KMEANS_PP_CENTERS)
        self.learning = np.array([self.vlad(descriptors) for descriptors in learning])

    def vlad(self, descriptors):
        descriptors = descriptors.astype(np.float32)
        nearest = ((self.words**2).sum(1) - 2 * descriptors @ self.words.T).argmin(1)
        belongs = (nearest == np.arange(WORDS)[:, None]).astype(np.float32)
        vector = belongs @ descriptors - belongs.sum(1, keepdims=True) * self.words
        vector /= np.linalg.norm(vector, axis=1, keepdims=True) + 1e-9
        return vector.ravel() / (np.linalg.norm(vector) + 1e-9)

    def nearest(self, query):
        return int((self.learning @ self.vlad(query)).argmax())


# Chosen with `days --tune`.
PEERS = {
    "aligned": Aligned(scale=4),
    "sift-vlad": SiftVlad((1024, 256), upright=True, contrast=0.04),
}

CANDIDATES = {
    "aligned, whole image": Aligned(),
    **{f"aligned, window {scale}": Aligned(scale=scale) for scale in (2, 4, 8)},
    **{
        f"SIFT-VLAD {width} x {width // 4}{', upright' if upright else ''}, contrast {contrast}":
            SiftVlad((width, width // 4), upright, contrast)
        for width in (512, 1024) for upright in (False, True) for contrast in (0.02, 0.04)
    },
}


def estimates(peers, lens, learning, positions_m, queries):
    """Positions that every one of `peers` gives for the `queries` (lists of paths), from `learning` images."""
    described = {name: [] for name in peers}
    for path in learning:
        panorama = lens.panorama(path)
        for name, peer in peers.items():
            described[name].append(peer.describe(panorama))
    for name, peer in peers.items():
        peer.learn(described[name])
    found = {name: [] for name in peers}
    for path in queries:
        panorama = lens.panorama(path)
        for name, peer in peers.items():
            found[name].append(positions_m[peer.nearest(peer.describe(panorama))])
    return {name: np.array(values) for name, values in found.items()}
