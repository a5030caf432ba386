"""Makes the extension's zip.

python integrations/blender/build.py [FOLDER]
"""

from __future__ import annotations

import sys
import tomllib
import zipfile
from pathlib import Path

SOURCE = Path(__file__).parent / "fusecap_motion"
SHARED = Path(__file__).parents[2] / "src/fusecap/exports/characters/bone_words.py"
"""What the package guesses bones by; the extension has the same."""


def main() -> None:
    manifest = tomllib.loads((SOURCE / "blender_manifest.toml").read_text(encoding="utf-8"))
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{manifest['id']}-{manifest['version']}.zip"
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in [*sorted(SOURCE.glob("*")), SHARED]:
            if path.suffix in (".py", ".toml"):
                archive.write(path, path.name)
    print(f"wrote {target}")


if __name__ == "__main__":
    main()
