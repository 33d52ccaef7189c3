"""Simulate pictures for readers without green cones, to whom different colors must not look alike.

    python -m experiments.shared.color_vision PICTURE.png ... [--out FOLDER]

Deuteranopia by Machado, Oliveira and Fernandes (2009), on linear light.
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


def simulate_color_vision(colours: np.ndarray) -> np.ndarray:
    """Colours, (..., 3) from 0 to 1 as pictures hold them, without green cones."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    observed_values = np.clip(linear @ DEUTERANOPIA_MATRIX.T, 0.0, 1.0)
    return np.where(
        observed_values <= 0.0031308,
        12.92 * observed_values,
        1.055 * observed_values ** (1.0 / 2.4) - 0.055,
    )


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("pictures", type=Path, nargs="+", metavar="PICTURE.png")
    parser.add_argument("--out", type=Path, default=Path("results/color_vision"))
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    for path in chosen.pictures:
        colours = np.asarray(Image.open(path).convert("RGB")) / 255.0
        Image.fromarray(np.uint8(np.round(255.0 * simulate_color_vision(colours)))).save(
            chosen.out / path.name
        )


if __name__ == "__main__":
    main()
