"""Both examples, small enough for two minutes on two cores; the pictures are in out/.

python examples/tour.py
"""

from pathlib import Path

import double_pendulum
import jax
import solar_system

jax.config.update("jax_enable_x64", True)


def main(out=Path("out"), sizes=("--members", "1000", "--duration", "15", "--resolution", "500")):
    pictures, _, _ = solar_system.main(["--out", str(out)])
    print()
    pictures += double_pendulum.main(["--out", str(out), *sizes])
    print(f"\nPictures in {Path(out).resolve()}:")
    for picture in pictures:
        print(f"  {picture.name}")
    return pictures


if __name__ == "__main__":
    main()
