"""JPEG -> the 356 properties of the paper with OpenCV and pyrtools, the way one would write it in Python."""

import cv2
import numpy as np
import pyrtools


class Chain:
    def __init__(self, donut):
        azimuth = (np.arange(1024) + 0.5) / 1024 * 2 * np.pi
        angle = donut["start_angle"] + (azimuth if donut["clockwise"] else -azimuth)
        inwards = (np.arange(256) + 0.5) / 256
        inwards = inwards if donut["top_is_outer"] else 1 - inwards
        radius = (donut["r_out"] - (donut["r_out"] - donut["r_in"]) * inwards)[:, None]
        x = (donut["cx"] + radius * np.cos(angle)).astype(np.float32)
        y = (donut["cy"] + radius * np.sin(angle)).astype(np.float32)
        self.maps = cv2.convertMaps(x, y, cv2.CV_16SC2)  # fixed point: faster than two float maps

    def properties(self, jpeg):
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        panorama = cv2.remap(image, *self.maps, cv2.INTER_LINEAR).astype(np.float32)
        gray = cv2.resize(panorama, (128, 128), interpolation=cv2.INTER_AREA)
        columns = cv2.reduce(panorama, 0, cv2.REDUCE_AVG)
        rows = cv2.reduce(gray, 1, cv2.REDUCE_SUM)
        fft = np.concatenate([magnitudes(rows.ravel()), magnitudes(columns.ravel()) * 16])
        histogram = cv2.calcHist([gray], [0], None, [156], [0, 256]).ravel()
        pyramid = pyrtools.pyramids.SteerablePyramidFreq(gray, height=4, order=5).pyr_coeffs
        zones = []
        for scale in range(4):
            for orientation in range(6):
                band = np.abs(pyramid[scale, orientation])
                cuts = [t * len(band) // 3 for t in range(4)]
                zones += [band[top:bottom].mean() for top, bottom in zip(cuts, cuts[1:])]
        return np.concatenate([fft, histogram, zones])


def magnitudes(signal):
    spectrum = cv2.dft(signal.reshape(1, -1), flags=cv2.DFT_COMPLEX_OUTPUT)[0, 1:65]
    return np.hypot(spectrum[:, 0], spectrum[:, 1])
