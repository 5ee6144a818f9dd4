"""Calls of Dask, without a cluster. `test_campaign_processes` starts real clusters."""

import sys
from concurrent.futures import Future
from types import SimpleNamespace

import distributed
import pytest

from ptsmc_jax.campaigns import cluster, store
from ptsmc_jax.campaigns.rows import Rows
from ptsmc_jax.campaigns.store import RefusedError


class FakeClient:
    """A fake client of Dask, which runs submitted functions immediately and records its own options.

    `FakeClient.made` is the client that was created last.
    """

    loop = None

    def __init__(self, **options):
        self.options, self.cancelled, self.closed = options, [], False
        FakeClient.made = self

    def submit(self, function, *arguments, **_):
        """Run the function at once and return a finished future with its result or its exception."""
        future = Future()
        try:
            future.set_result(function(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    def cancel(self, futures):
        """Record the cancelled futures."""
        self.cancelled = futures

    def close(self):
        """Record that the client is closed."""
        self.closed = True


@pytest.fixture(autouse=True)
def _dask(monkeypatch):
    """Replace the client of Dask by `FakeClient`."""
    monkeypatch.setattr(distributed, "Client", FakeClient)
    monkeypatch.setattr(distributed, "as_completed", lambda futures, **_: iter(futures))


def campaign_with_workers(monkeypatch, tmp_path, receipt):
    """Make cluster workers answer with `receipt(first trial, number of trials)`; return a fake campaign.

    The fake campaign is an argument of the function that `cluster.connect` returns.
    """
    monkeypatch.setattr(cluster, "_simulate_part", lambda recipe, first, count: receipt(first, count))
    return SimpleNamespace(recipe=lambda: (None, "x"), rows=Rows(tmp_path, b"k"))


def test_tls_files_are_passed_to_dask_and_require_encryption():
    """Without files, the connection has no security options. Closing the cluster closes the client."""
    files = {"tls_ca_file": "ca.pem", "tls_client_cert": "cert.pem", "tls_client_key": "key.pem"}
    found = cluster.connect("tls://10.0.0.1:8786", files)
    security = FakeClient.made.options["security"]
    assert FakeClient.made.options["address"] == "tls://10.0.0.1:8786"
    assert {name: getattr(security, name) for name in files} == files
    assert security.require_encryption is True
    found.close()
    assert FakeClient.made.closed
    cluster.connect("tcp://127.0.0.1:8786", {})
    assert FakeClient.made.options["security"] is None


def test_a_local_cluster_listens_on_the_loopback_only(monkeypatch):
    asked = {}
    monkeypatch.setattr(distributed, "LocalCluster", lambda **options: asked.update(options) or SimpleNamespace())
    cluster.connect("local:3", {})
    assert (asked["host"], asked["n_workers"], asked["threads_per_worker"]) == ("127.0.0.1", 3, 1)


def test_results_of_cluster_workers_become_parts_of_the_campaign(monkeypatch, tmp_path):
    here = store.packages()
    (tmp_path / "p.parquet").write_bytes(b"")
    campaign = campaign_with_workers(monkeypatch, tmp_path, lambda first, count: (first, count, "p.parquet", 7, here))
    found = list(cluster.connect("tcp://a:1", {})(campaign, [(0, 10), (10, 5)]))
    assert [(part.first, part.count, failed) for part, failed in found] == [(0, 10, 7), (10, 5, 7)]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"jax": "0.0.1"}, "has jax 0.0.1, but here is"),
        ({"code_checksum": "0a"}, "has code_checksum 0a, but here is"),
        (None, r"a worker wrote gone.parquet, which is not in .* here: it must be shared"),
        (ValueError("no\nroom"), "a worker of the cluster failed: no room"),
    ],
)
def test_cluster_workers_that_failed_or_have_other_versions_are_refused(monkeypatch, tmp_path, change, said):
    """A worker that wrote into a folder that is not shared is refused too. The other futures are cancelled."""

    def receipt(first, count):
        if isinstance(change, Exception):
            raise change
        versions = store.packages() | (change or {})
        return first, count, "gone.parquet", 0, versions

    campaign = campaign_with_workers(monkeypatch, tmp_path, receipt)
    with pytest.raises(RefusedError, match=said):
        list(cluster.connect("tcp://a:1", {})(campaign, [(0, 10)]))
    assert len(FakeClient.made.cancelled) == 1  # the other futures are cancelled


def test_a_cluster_without_dask_is_refused_with_the_command_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(RefusedError, match=r"pip install 'ptsmc-jax\[cluster\]'"):
        cluster.connect("tcp://a:1", {})
