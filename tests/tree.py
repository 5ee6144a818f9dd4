"""Paths of the project's files and names of its modules. Nothing of the project is imported."""

from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("ptsmc_jax", "tuning")
# options that halve the compile time and reduce the speed to a third, for programs that run once
QUICKLY = (
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_llvm_enable_alias_scope_metadata=false --xla_llvm_enable_noalias_metadata=false"
)


@cache
def modules(*packages: str) -> dict[str, Path]:
    """Return {dotted name: path} of all modules, `__init__` of packages included; packages: by default `PACKAGES`."""
    found = {}
    for package in packages or PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found
