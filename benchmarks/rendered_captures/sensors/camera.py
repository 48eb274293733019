"""m"""

import cv2
import numpy as np


def develop_rgb(lin, exposure, rng, night):
    """Exposure, photon shot noise and read noise in the linear domain, ACES-like curve, sRGB, 8 bit."""
    x = lin * exposure
    full, read = (140.0, 2.5) if night else (9000.0, 6.0)  # electrons at linear 1.0; read noise
    x = np.clip((rng.poisson(np.clip(x, 0, 60) * full) + rng.normal(0, read, x.shape)) / full, 0, None)
    x = np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0, 1)
    return u8(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055) + 0.5)


def sense_thermal(lin, rng):
    """PSF blur on radiance, inversion to apparent deg C, NETD noise."""
    L = cv2.GaussianBlur(lin.mean(-1), (0, 0), PSF_SIGMA_PX)
    return (temperature_of(L) + rng.normal(0, NETD_K, L.shape)).astype(np.float32)


def round_depth(z):
    """float32 metres with the noise-free low bits zeroed, so that the npz compresses: step <= median / 2000."""
    step = 2.0 ** np.floor(np.log2(np.median(z[z > 0]) / 2000))
    return (np.round(z / step) * step).astype(np.float32)


def raw_counts(t):
    """16-bit centi-Kelvin in steps of 4 (40 mK, below the NETD; the noise would otherwise fill the file)."""
    v = np.round((t + 273.15) * 100).astype(np.int64)
    return ((v + 2) // 4 * 4).astype(np.uint16)


def colorize(t, lo, hi, lut):
    return lut[np.clip(np.round((t - lo) / (hi - lo) * 255), 0, 255).astype(int)]


def save_jpg(path, rgb):
    cv2.imwrite(str(path), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
