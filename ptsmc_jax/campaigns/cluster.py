"""Campaigns on a Dask cluster: workers fly parts and write them into the shared folder; only receipts travel back.

A worker that is lost has its parts flown again by another; a part is the same whoever flies it.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.campaign import Campaign, Wanted, failures
from ptsmc_jax.campaigns.rows import Part, Rows
from ptsmc_jax.campaigns.store import RefusedError

LOST = 5  # workers that may be lost with a part before it is given up
_one_at_a_time = threading.Lock()  # a part takes all devices of its process


class Cluster:
    """A connection; call it with a folder and the wanted parts."""

    def __init__(self, client: Any, local: Any = None):
        self._client, self._local = client, local

    def __call__(self, folder: Any, wanted: list[Wanted]) -> Iterator[tuple[Part, int]]:
        """Have the wanted parts flown; yields each part that is there, and how many of its trials did not end well.

        folder: a campaign's, with `recipe()`, which all workers see under the same path. Raises RefusedError where
        they do not, where their versions differ from those here, or where a part is lost with too many workers.
        """
        from distributed import as_completed

        recipe, rows, here = folder.recipe(), folder.rows, store.packages()
        futures = [self._client.submit(_fly, recipe, *part, pure=False, retries=0) for part in wanted]
        try:
            for future in as_completed(futures, loop=self._client.loop):
                error = future.exception()
                if error is not None:
                    raise RefusedError(f"a worker of the cluster failed: {_sentence(error)}")
                first, count, name, failed, versions = future.result()
                if versions != here:
                    key = next(key for key in versions if versions[key] != here[key])
                    raise RefusedError(f"a worker of the cluster has {key} {versions[key]}, but here is {here[key]}")
                path = rows.folder / name
                if not path.is_file():
                    raise RefusedError(f"a worker wrote {name}, which is not in {rows.folder} here: it must be shared")
                yield Part(first, count, path), failed
        finally:
            self._client.cancel(futures)

    def close(self) -> None:
        """Let the cluster go; one that was started here ends."""
        self._client.close()
        if self._local is not None:
            self._local.close()


def connected(address: str, tls: Mapping[str, str]) -> Cluster:
    """A cluster by its address (tcp://host:port, tls://host:port), scheduler file (.json), or "local:N".

    "local:N" starts N processes on this machine that listen on the loopback only. tls: `distributed.Security`'s
    options. Raises RefusedError where there is no such cluster, or Dask is not installed.
    """
    try:
        from dask import config
        from distributed import Client, LocalCluster, Security
    except ImportError:
        raise RefusedError("--cluster needs Dask, which is not installed: pip install 'ptsmc-jax[cluster]'") from None
    config.set({"distributed.scheduler.allowed-failures": LOST})
    security = Security(**tls, require_encryption=True) if tls else None
    local = None
    if address.startswith("local:"):
        count = address.removeprefix("local:")
        if not (count.isdigit() and 1 <= int(count) <= 1024):
            raise RefusedError(f"--cluster is {address}, but must be local:N with N a whole number from 1 to 1024")
        local = LocalCluster(
            n_workers=int(count), threads_per_worker=1, host="127.0.0.1", dashboard_address=":0", processes=True
        )
    where: dict[str, Any] = {"address": address if local is None else local}
    if address.endswith(".json"):
        if not Path(address).is_file():
            raise RefusedError(f"--cluster is {address}, which is not there")
        where = {"scheduler_file": address}
    try:
        return Cluster(Client(**where, security=security, timeout="10s", set_as_default=False), local)
    except (OSError, ValueError, TypeError) as error:
        raise RefusedError(f"--cluster is {address}, which does not answer: {_sentence(error)}") from None


def _sentence(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@lru_cache(maxsize=4)
def _campaign(make: Callable[..., tuple[Campaign, Rows]], arguments: tuple) -> tuple[Campaign, Rows]:
    from ptsmc_jax.configure import configure

    with contextlib.suppress(RuntimeError):  # the worker's process has used JAX already
        configure(keep_programs=True)
    return make(*arguments)


def _fly(recipe: tuple[Callable, tuple], first: int, count: int) -> tuple:
    """On a worker: fly a part and write it. Returns its receipt: first trial, count, file, failures, versions."""
    with _one_at_a_time:
        campaign, rows = _campaign(*recipe)
        frame = campaign.fly(range(first, first + count))
    part = rows.write(first, frame)
    return first, count, part.path.name, failures(frame), store.packages()
