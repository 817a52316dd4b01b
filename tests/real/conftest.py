"""Drives among the real data."""

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def drive(data_dir: Path):
    """Gives where a drive is; tests that need it are skipped where it is absent."""

    def find(name: str) -> Path:
        if not (data_dir / name).exists():
            pytest.skip(f"no drive at {data_dir / name}")
        if "argoverse2/" in f"{name}/":
            pytest.importorskip("pyarrow", reason="pyarrow is not installed")
        return data_dir / name

    return find
