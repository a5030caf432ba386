"""What `import fusecap` offers: every name once, on demand, and known to type checkers."""

import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import fusecap

ROOT = Path(__file__).resolve().parents[1]


def test_every_public_name_loads_from_its_home():
    names = fusecap.__all__
    assert len(names) == len(set(names)) and {"Pipeline", "Tracker", "Setup"} <= {*names}
    assert {*names} <= {*dir(fusecap)}
    for name in names:
        value = getattr(fusecap, name)
        assert getattr(value, "__name__", name) == name
        assert getattr(fusecap, name) is value
    assert fusecap.__version__ == metadata.version("fusecap")


def test_a_name_that_is_not_there_is_an_error():
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'"):
        fusecap.Nonsense  # noqa: B018
    with pytest.raises(ImportError):
        from fusecap import Nonsense  # noqa: F401


def test_a_star_import_brings_the_public_names():
    code = "from fusecap import *; print(Pipeline.__name__, Estimate.__name__)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.split() == ["Pipeline", "Estimate"], result.stderr


@pytest.mark.slow
def test_type_checkers_know_the_names_and_no_others(tmp_path):
    names = "\n".join(f"fusecap.{name}" for name in [*fusecap.__all__, "__version__"])
    (tmp_path / "fine.py").write_text(f"import fusecap\n{names}\n")
    (tmp_path / "missing.py").write_text("import fusecap\nfusecap.Nonsense\n")
    imported = "from fusecap import Setup, Nonsense\ncount: int = Setup\n"
    (tmp_path / "imported.py").write_text(imported)
    pyright = shutil.which("pyright", path=str(Path(sys.executable).parent))
    if pyright is None:
        pytest.skip("pyright is not installed")
    result = subprocess.run(
        [pyright, "--pythonpath", sys.executable, *sorted(tmp_path.glob("*.py"))],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    errors = [line.strip() for line in result.stdout.splitlines() if "error:" in line]
    assert len(errors) == 3, result.stdout
    assert not any("fine.py" in line and "missing.py" not in line for line in errors)
    assert sum("Nonsense" in line for line in errors) == 2
