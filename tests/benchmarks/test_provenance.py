"""A result names the commit that made it."""

import subprocess
from pathlib import Path

from benchmarks import provenance


def git(folder, *arguments):
    identity = ["-c", "user.name=a", "-c", "user.email=a@example.org"]
    done = subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_a_package_that_is_installed_in_somebodys_checkout_is_not_of_its_commit(tmp_path, monkeypatch):
    git(tmp_path, "init")
    (tmp_path / "theirs.py").touch()
    git(tmp_path, "add", "theirs.py")
    git(tmp_path, "commit", "-m", "theirs")
    (tmp_path / "ours.py").touch()
    commit = provenance.commit.__wrapped__  # looked up once in a process
    monkeypatch.setattr(provenance, "__file__", str(Path(tmp_path) / "ours.py"))
    assert commit() is None
    git(tmp_path, "add", "ours.py")
    git(tmp_path, "commit", "-m", "ours")
    assert commit() == git(tmp_path, "rev-parse", "HEAD")
    (tmp_path / "ours.py").write_text("changed")
    assert commit() == git(tmp_path, "rev-parse", "HEAD") + "-dirty"
