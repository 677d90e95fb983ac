"""The words of src/features/words.rs: centres of patches of simulated places.

    python benches/ablation/words.py DATASET...

DATASETs are folders as `omniloc simulate --out` writes them; those of today: hall, seed 11, 1.6 m apart; town, seed 12;
corridor, seed 11.
"""

import sys
from itertools import islice
from pathlib import Path

import cv2
import numpy as np

from ablation import WORDS, panoramas, patches

random = np.random.default_rng(0)
sample = []
for folder in sys.argv[1:]:
    for panorama in islice(panoramas(Path(folder)), 0, None, 4):
        sample.append(random.permutation(patches(panorama))[:150])
sample = np.concatenate(sample)
cv2.setRNGSeed(0)
criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
_, _, words = cv2.kmeans(sample, 128, None, criteria, 1, cv2.KMEANS_PP_CENTERS)
assert np.abs(words).max() < 127 / 128, "words are stored in units of 1/128"
np.round(words * 128).astype(np.int8).tofile(WORDS)
print(f"{len(sample)} patches, {len(words)} words, largest coefficient {np.abs(words).max():.2f}")
