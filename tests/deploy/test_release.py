"""What `make dist` relies on: version numbers that agree, and a commit to build from. `make dist` checks the rest."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

from router import __version__

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0


def test_the_pages_name_the_wheel_of_this_version() -> None:
    named = [
        (page.name, version)
        for page in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]
        for version in re.findall(r"rover_router-([0-9][^-]*)-py3", page.read_text())
    ]
    assert named
    assert {version for _, version in named} == {__version__}, named


def test_the_changelog_has_an_entry_for_this_version_below_unreleased_changes_only() -> None:
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[headings[0] == "Unreleased"] == __version__


def test_a_release_is_built_from_a_commit_only(tmp_path: Path) -> None:
    scripts = tmp_path / "deploy"
    scripts.mkdir()
    for name in ("dist.sh", "find-python.sh"):
        shutil.copy(ROOT / "deploy" / name, scripts)
    subprocess.run([shutil.which("git") or "git", "init", "--quiet", tmp_path], check=True)
    done = subprocess.run([scripts / "dist.sh"], cwd="/", capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        "dist: commit these changes first, because a release is built from a commit:\ndist: ?? deploy/\n"
    )
