"""What a release's two files hold: python .ci/check_dist.py FOLDER. The package and nothing else in the wheel, all of the project in the other."""

import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("torchchain", "tests", "docs", "experiments", "notebooks", "recipe")
MADE = {"__pycache__", "_build", "_generated", "results"}


def sources(*folders: str) -> set[str]:
    """Files of the working tree, without what runs and builds leave there."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file())
    found = (path.relative_to(ROOT) for path in paths)
    return {path.as_posix() for path in found if not MADE & {*path.parts} and not path.name.startswith(".")}


def main(folder: str) -> int:
    """Compare, print what is missing or too much, and return the exit status."""
    (wheel,), (archive,) = Path(folder).glob("*.whl"), Path(folder).glob("*.tar.gz")
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    with tarfile.open(archive) as tar:
        source = {member.name.partition("/")[2] for member in tar.getmembers() if member.isfile()}
    package = sources("torchchain")
    for name in ("torchchain/py.typed", "torchchain/__init__.pyi"):
        assert name in package, name
    wrong = {
        f"{wheel.name} lacks": package - packed,
        f"{wheel.name} holds": packed - package,
        f"{archive.name} lacks": sources(*FOLDERS) - source,
    }
    for what, names in wrong.items():
        for name in sorted(names):
            print(f"{what} {name}", file=sys.stderr)
    print(f"{wheel.name}: {len(packed)} files, {wheel.stat().st_size / 1e6:.2f} MB; {archive.name}: {len(source)} files")
    return int(any(wrong.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
