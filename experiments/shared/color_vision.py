"""Simulate how a reader with deuteranopia sees a picture, to check that different colors stay
distinct.

    python -m experiments.shared.color_vision PICTURE.png ... [--out FOLDER]

The matrix of Machado, Oliveira and Fernandes (2009) acts on linear light.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from experiments.shared.command import make_parser

DEUTERANOPIA_MATRIX = np.array([
    [0.367322, 0.860646, -0.227968],
    [0.280085, 0.672501, 0.047413],
    [-0.011820, 0.042940, 0.968881],
])  # fmt: skip


def simulate_color_vision(colors: np.ndarray) -> np.ndarray:
    """Return colors as a reader with deuteranopia sees them, sRGB from 0 to 1, shape (..., 3)."""
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
    simulated_light = np.clip(linear @ DEUTERANOPIA_MATRIX.T, 0.0, 1.0)
    return np.where(
        simulated_light <= 0.0031308,
        12.92 * simulated_light,
        1.055 * simulated_light ** (1.0 / 2.4) - 0.055,
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("pictures", type=Path, nargs="+", metavar="PICTURE.png")
    parser.add_argument("--out", type=Path, default=Path("results/color_vision"))
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for path in arguments.pictures:
        colors = np.asarray(Image.open(path).convert("RGB")) / 255.0
        Image.fromarray(np.uint8(np.round(255.0 * simulate_color_vision(colors)))).save(
            arguments.out / path.name
        )


if __name__ == "__main__":
    main()
