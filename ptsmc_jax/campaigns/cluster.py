"""Campaigns on a Dask cluster: workers simulate parts and write them into a shared folder; they return receipts.

If a worker is lost, another worker simulates its parts again, with equal results.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.campaign import Block, Campaign, count_failures
from ptsmc_jax.campaigns.rows import Part, Rows
from ptsmc_jax.campaigns.store import RefusedError

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

ALLOWED_LOSSES = 5  # the campaign fails if more workers than this are lost while they simulate the same part
_one_at_a_time = threading.Lock()  # because a part uses all devices of its process


class Cluster:
    """A connection to a cluster. A call with a folder and the wanted parts simulates these parts on its workers."""

    def __init__(self, client: "Client", local: "LocalCluster | None" = None):
        self._client, self._local = client, local

    def __call__(self, folder: Any, wanted: list[Block]) -> Iterator[tuple[Part, int]]:
        """Simulate the wanted parts on the workers.

        Args:
            folder: the campaign's folder, with `recipe()`; all workers need it at the same path.
            wanted: first trial and number of trials of each part.

        Yields:
            Each part on disk, and its number of failed trials.

        Raises:
            RefusedError: a worker does not share the folder, has other versions, or was lost too often.
        """
        from distributed import as_completed

        recipe, rows, our_versions = folder.recipe(), folder.rows, store.packages()
        futures = [self._client.submit(_simulate_part, recipe, *part, pure=False, retries=0) for part in wanted]
        try:
            for future in as_completed(futures, loop=self._client.loop):
                error = future.exception()
                if error is not None:
                    raise RefusedError(f"a worker of the cluster failed: {_format_error(error)}")
                first, count, name, failed, versions = future.result()
                if versions != our_versions:
                    key = next(key for key in versions if versions[key] != our_versions[key])
                    raise RefusedError(
                        f"a worker of the cluster has {key} {versions[key]}, but here is {our_versions[key]}"
                    )
                path = rows.folder / name
                if not path.is_file():
                    raise RefusedError(f"a worker wrote {name}, which is not in {rows.folder} here: it must be shared")
                yield Part(first, count, path), failed
        finally:
            self._client.cancel(futures)

    def close(self) -> None:
        """Close the connection; a local cluster ends."""
        self._client.close()
        if self._local is not None:
            self._local.close()


def connect(address: str, tls: Mapping[str, str]) -> Cluster:
    """Connect to a cluster.

    Args:
        address: tcp://host:port, tls://host:port, a scheduler file (.json), or "local:N", which starts N processes on
            this machine that listen on the loopback interface only.
        tls: options of `distributed.Security`.

    Returns:
        The connection.

    Raises:
        RefusedError: there is no such cluster, or Dask is not installed.
    """
    try:
        from dask import config
        from distributed import Client, LocalCluster, Security
    except ImportError:
        raise RefusedError("--cluster needs Dask, which is not installed: pip install 'ptsmc-jax[cluster]'") from None
    config.set({"distributed.scheduler.allowed-failures": ALLOWED_LOSSES})
    security = Security(**tls, require_encryption=True) if tls else None
    local = None
    if address.startswith("local:"):
        count = address.removeprefix("local:")
        if not (count.isdigit() and 1 <= int(count) <= 1024):
            raise RefusedError(f"--cluster is {address}, but must be local:N with N a whole number from 1 to 1024")
        local = LocalCluster(
            n_workers=int(count), threads_per_worker=1, host="127.0.0.1", dashboard_address=":0", processes=True
        )
    target: dict[str, Any] = {"address": address if local is None else local}
    if address.endswith(".json"):
        if not Path(address).is_file():
            raise RefusedError(f"--cluster is {address}, which does not exist")
        target = {"scheduler_file": address}
    try:
        return Cluster(Client(**target, security=security, timeout="10s", set_as_default=False), local)
    except (OSError, ValueError, TypeError) as error:
        raise RefusedError(f"--cluster is {address}, which does not answer: {_format_error(error)}") from None


def _format_error(error: BaseException) -> str:
    """Return the text of an error in one line, or its type if it has no text."""
    return " ".join(str(error).split()) or type(error).__name__


@lru_cache(maxsize=4)
def _make_campaign(make: Callable[..., tuple[Campaign, Rows]], arguments: tuple) -> tuple[Campaign, Rows]:
    """On a worker: configure JAX, and make the campaign and its rows; equal calls get the same objects."""
    from ptsmc_jax.configure import configure

    with contextlib.suppress(RuntimeError):  # the worker's process has used JAX already
        configure(keep_programs=True)
    return make(*arguments)


def _simulate_part(recipe: tuple[Callable, tuple], first: int, count: int) -> tuple:
    """On a worker: simulate and write a part. Return first trial, count, file name, failures and versions."""
    with _one_at_a_time:
        campaign, rows = _make_campaign(*recipe)
        frame = campaign.simulate(range(first, first + count))
    part = rows.write(first, frame)
    return first, count, part.path.name, count_failures(frame), store.packages()
