"""Where the project's files lie, and what its modules are called; imports none of them."""

from functools import cache
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("ptsmc_jax", "tuning")
# what compiles in half the time and flies at a third of the speed: for programs that fly once
QUICKLY = (
    "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1 "
    "--xla_llvm_enable_alias_scope_metadata=false --xla_llvm_enable_noalias_metadata=false"
)


@cache
def modules(*packages: str) -> dict[str, Path]:
    """Files by the dotted names of their modules, folders' own `__init__` among them."""
    found = {}
    for package in packages or PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found
