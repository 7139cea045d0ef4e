"""The pictures of the worked problems, each run as a script, small enough for a page: examples/gallery/NAME.png.

python examples/gallery.py [NAME ...]
"""

import runpy
import sys
from pathlib import Path

import matplotlib.pyplot as plt
from PIL import Image  # comes with matplotlib

FOLDER = Path(__file__).parent
NAMES = (
    "spring_pendulum",
    "bead_on_hoop",
    "sliding_wedge",
    "double_pendulum_chaos",
    "rolling_cylinder",
    "tumbling_cube",
    "foucault",
    "crossed_fields",
    "symmetric_top",
    "restricted_three_body",
    "driven_pendulum",
    "mercury_perihelion",
    "fput",
    "sine_gordon",
    "membrane",
    "net",
)


def main(names=NAMES):
    for name in names or NAMES:
        print(f"\n{name}")
        runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
        plt.close("all")
        picture = Image.open(f"out/{name}.png").convert("RGB")
        picture.quantize(96).save(FOLDER / "gallery" / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main(sys.argv[1:])
