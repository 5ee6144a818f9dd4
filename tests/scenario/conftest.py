"""Fixtures of tests with custom code."""

import pytest

from ptsmc_jax.scenario import systems


@pytest.fixture
def here(tmp_path, monkeypatch, request):
    """Change to an empty folder with the `FILES` of the test module; return it. No custom file counts as run yet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(systems, "_executed_files", {})
    for name, text in request.module.FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path
