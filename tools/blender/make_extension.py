"""Packs the Blender extension "tiface run" (tiface_import.py beside this script) into one zip.

    python tools/blender/make_extension.py [tiface_import.zip]

In Blender 4.2 or newer: Edit > Preferences > Get Extensions > Install from Disk (the arrow at the top right), or drop the zip
on a window. Then File > Import > tiface run.
"""

import pathlib
import sys
import zipfile

HERE = pathlib.Path(__file__).resolve().parent
# the name in the zip, and the file that it is
FILES = {"blender_manifest.toml": "blender_manifest.toml", "__init__.py": "tiface_import.py"}


def main():
    out = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "tiface_import.zip")
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as package:
        for name, file in FILES.items():
            # the same bytes whenever it is packed
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            package.writestr(entry, (HERE / file).read_bytes(), zipfile.ZIP_DEFLATED)
    print(out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
