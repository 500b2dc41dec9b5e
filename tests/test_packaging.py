"""What `pip install` brings: all that `import sb3_rpto` imports, without an extra."""

import ast
import configparser
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def imported_at_once(path: Path) -> set[str]:
    """Packages that a module imports when it is imported itself."""
    found: set[str] = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Import):
            found |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found - set(sys.stdlib_module_names) - {"sb3_rpto"}


def test_the_package_imports_with_what_it_requires() -> None:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    required = {re.split(r"[\[<>=]", line)[0] for line in config["options"]["install_requires"].split("\n") if line}
    code = "import sb3_rpto, sys; print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('sb3_rpto')))"
    files = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT)
    packages = set().union(*(imported_at_once(Path(file)) for file in files.stdout.split()))
    assert {"mujoco", "scipy", "torch"} <= packages
    distributions = importlib.metadata.packages_distributions()
    missing = [p for p in packages if not {d.lower().replace("_", "-") for d in distributions[p]} & required]
    assert not missing
