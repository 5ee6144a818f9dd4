"""Campaign folders: create, open and identify a Monte Carlo campaign, and simulate its trials.

A campaign is identified by its scenario, its seed and checksums of all custom code. `Folder` has these data. `begin`
creates a folder, `open_folder` reads one, and `simulate` simulates the missing trials. Read `Folder` first.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import polars as pl
from msgspec import Meta

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign as running
from ptsmc_jax.campaigns import rows, run_tables, store
from ptsmc_jax.campaigns.campaign import Block, Campaign, Tally
from ptsmc_jax.campaigns.rows import Part, Rows
from ptsmc_jax.campaigns.run_tables import RunTable
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.dispersions import quantities
from ptsmc_jax.onboard import sources
from ptsmc_jax.onboard.library import InTheLoop, Library
from ptsmc_jax.scenario import Study, custom, parsing, systems
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Software
from tuning.search import custom_parts
from tuning.studies import campaign_theory

C_FOLDER = "controller"  # subfolder with the C code of the controller, if C code controls the simulated spacecraft
TABLE = "run_table.parquet"  # the run table; `--dry-run` writes a folder instead
RUN_TABLE = "run_table_sha256"  # key of the checksum of the run table in `versions.json`
CUSTOM = f"{systems.NAME_FORMS}, a function of a run's Result and its Parts that returns named numbers"


class CampaignVersions(msgspec.Struct, frozen=True):
    """Entries of `versions.json` that define the rows of a campaign."""

    command: Literal["montecarlo"]
    seed: Annotated[int, Meta(ge=0, lt=2**32)]
    trials: Annotated[int, Meta(ge=1, le=2**32)]
    precision: Literal[32, 64]
    scenario_checksum: str
    metrics: str | None = None
    metrics_names: tuple[str, ...] | None = None
    run_table: str | None = None  # file name of the run table
    controller_otherwise: str | None = None  # parameters of C code that differ from the scenario, in words


@dataclass(frozen=True)
class Folder:
    """A campaign and its folder."""

    path: Path
    scenario: Scenario
    seed: int
    trials: int  # number of trials of the complete campaign
    custom_metrics: str | None = None  # FILE.py:NAME of the function that computes custom metrics
    bits: int = 64  # floating-point precision
    stored_versions: CampaignVersions | None = None  # entries of the existing folder; None: it does not exist yet
    checksums: Mapping[str, str] = field(default_factory=dict)  # checksums of custom code in the existing folder
    trusted: bool = True  # whether custom code may be executed
    table_name: str | None = None  # file name of the run table
    table: pl.DataFrame | None = None  # content of the run table
    controller: Path | None = None  # folder of the C code that controls; None: the simulated law controls

    @cached_property
    def custom_code(self) -> dict[str, str]:
        """The locations of all custom code that the campaign executes, by scenario key or option."""
        return custom_parts.list_custom_code(self.scenario, self.custom_metrics, self.controller)

    @cached_property
    def code_and_data_files(self) -> dict[str, str]:
        """The locations of custom code and data files, by scenario key or option."""
        return self.custom_code | custom.data_files_by_key(self.scenario)

    @cached_property
    def identity(self) -> dict[str, object]:
        """The entries of `versions.json` that identify the campaign.

        The checksums are those in the folder if it exists, else those of the present files.
        """
        checksums = {}
        for key, where in self.code_and_data_files.items():
            name = custom.checksum_name(key)
            checksums[name] = self.checksums.get(name) if self.stored_versions else custom_parts.checksum(key, where)
        if self.table is not None:
            checksums[RUN_TABLE] = self.checksums.get(RUN_TABLE) if self.stored_versions else self.run_table.checksum
        metrics = {} if self.custom_metrics is None else {"metrics": self.custom_metrics}
        present = {name: checksum for name, checksum in checksums.items() if checksum is not None}
        return {"command": "montecarlo", "seed": self.seed, "precision": self.bits, **metrics, **present}

    @property
    def versions(self) -> dict[str, object]:
        """The content of `versions.json`."""
        names = None if self.custom_metrics is None else self.custom_metric_names
        entries = {
            **self.identity,
            "scenario_checksum": self.scenario_checksum,
            "trials": self.trials,
            "metrics_names": names,
            "run_table": self.table_name,
        }
        if self.controller is not None:
            entries |= {C_FOLDER: C_FOLDER, "controller_otherwise": self.parameter_differences or None}
        return store.versions(**{name: value for name, value in entries.items() if value is not None})

    @property
    def scenario_checksum(self) -> str:
        """The checksum of the scenario with all defaults."""
        return rows.campaign_key(parsing.dump(self.scenario), {}).hex()

    @cached_property
    def custom_metric_names(self) -> list[str]:
        """The names of the custom metrics."""
        if self.custom_metrics is None:
            return []
        if self.stored_versions is None:
            return self._campaign_without_table.custom_metric_names()
        return list(self.stored_versions.metrics_names or ())

    @property
    def units(self) -> dict[str, str]:
        """The units of metrics and dispersions by column, if they are known."""
        drawn = {} if self.ready is None else quantities.units(self.ready.parts)
        return catalogues.units(self.scenario.plant.kind) | drawn

    @cached_property
    def rows(self) -> Rows:
        """The result rows of the trials."""
        return Rows(self.path / rows.FOLDER, self._checksum_key)

    @cached_property
    def dry_run_rows(self) -> Rows:
        """The dispersions of the trials, which `--dry-run` writes without simulating."""
        return Rows(self.path / "runs", self._checksum_key)

    @property
    def _checksum_key(self) -> bytes:
        """The key of the checksums in the names of the parts, so that no part of another campaign is accepted."""
        return rows.campaign_key(parsing.dump(self.scenario), self.identity)

    @cached_property
    def ready(self) -> Study | None:
        """The scenario, ready to simulate without custom metrics; None if that would execute untrusted custom code."""
        code_keys = set(self.custom_code) - {custom_parts.METRICS, custom_parts.CONTROLLER}
        if code_keys and not self.trusted:
            return None
        for key in (*code_keys, *custom.data_files_by_key(self.scenario)):
            self._check_unchanged(key)
        return scenario.study(self.scenario)

    @cached_property
    def computer(self) -> InTheLoop | None:
        """The compiled C code of the controller, or None if there is none.

        Raises RefusedError if the C code is not trusted.
        """
        if self.controller is None:
            return None
        if not self.can_simulate:
            raise self._untrusted_code_error
        assert self.ready is not None
        self._check_unchanged(custom_parts.CONTROLLER)
        return InTheLoop(Library(self.controller), self.ready.parts, self.ready.dispersion)

    @property
    def parameter_differences(self) -> str:
        """A sentence about parameters that differ between the C code and the scenario; empty if none differ."""
        if self.stored_versions is not None:
            return self.stored_versions.controller_otherwise or ""
        return "" if self.computer is None else self.computer.parameter_differences

    @property
    def software(self) -> Software:
        """The `Software` that the simulation runs: the exported C code, or the law in Python."""
        return PYTHON_SOFTWARE if self.computer is None else self.computer.software

    @property
    def can_simulate(self) -> bool:
        """Whether the trials can be simulated without executing untrusted code, apart from custom metrics."""
        return self.ready is not None and (self.controller is None or self.trusted)

    @property
    def _untrusted_code_error(self) -> RefusedError:
        """The error for custom code in a folder that is read without --trust."""
        return RefusedError(f"{self.path} names custom code, which is run with --trust only")

    @cached_property
    def run_table(self) -> RunTable:
        """The validated run table. Raises RefusedError if it is invalid or has changed since the campaign began."""
        assert self.table is not None
        assert self.ready is not None
        description = f"the run table {self.table_name}"
        custom_inputs = self.ready.dispersion.custom_names()
        table = run_tables.check_table(
            self.table, self.ready.parts, description, self.custom_metric_names, custom_inputs
        )
        if self.stored_versions is not None and table.checksum != self.checksums.get(RUN_TABLE):
            raise RefusedError(f"{self.path / TABLE} has changed: it is not the run table of the campaign")
        return table

    @cached_property
    def campaign_without_metrics(self) -> Campaign:
        """The campaign without custom metrics. Raises RefusedError if it needs untrusted code."""
        if self.ready is None:
            raise self._untrusted_code_error
        campaign = Campaign(self.ready, self.seed)
        if self.table is not None:
            where = f"the run table {self.table_name}"
            campaign = running.from_run_table(self.ready, self.seed, self.run_table, where=where)
        return replace(campaign, software=self.software)

    @cached_property
    def campaign(self) -> Campaign:
        """The campaign.

        Raises ScenarioError if the custom metrics are invalid, and RefusedError if the campaign needs untrusted code.
        """
        # before `campaign_without_metrics`, so that errors of the metrics are raised first
        custom_metrics = self._campaign_without_table.custom_metrics
        return replace(self.campaign_without_metrics, custom_metrics=custom_metrics)

    @cached_property
    def _campaign_without_table(self) -> Campaign:
        """The campaign with custom metrics, but without the run table."""
        if self.ready is None or (self.custom_metrics is not None and not self.trusted):
            raise self._untrusted_code_error
        if self.custom_metrics is None:
            return Campaign(self.ready, self.seed)
        self._check_unchanged(custom_parts.METRICS)
        software = self.software
        try:
            metrics: Any = systems.load_object(self.custom_metrics, CUSTOM)
            if not isinstance(metrics, Callable):
                raise ValueError(f"it is of type {type(metrics).__name__}, but must be {CUSTOM}")
            campaign = Campaign(self.ready, self.seed, metrics, software=software)
            campaign.custom_metric_names()
            return campaign
        except ValueError as error:
            raise ScenarioError(f"--metrics is {self.custom_metrics}: {error}") from None

    def _check_unchanged(self, key: str) -> None:
        """Raise RefusedError if the file of a key has another content than in the stored campaign."""
        if self.stored_versions is not None:
            custom_parts.check_unchanged({key: self.code_and_data_files[key]}, self.path, self.identity)

    def recipe(self) -> tuple[Callable, tuple[str, str]]:
        """Return a function and its arguments. Another process calls it to rebuild the campaign and its rows."""
        return rebuild_campaign, (str(self.path.resolve()), self._checksum_key.hex())

    def stored_parts(self) -> list[Part]:
        """Return the parts of the rows, if there are any. Raises RefusedError if a part is damaged."""
        parts, broken = self.rows.parts()
        if broken:
            self.check_scenario()
            raise RefusedError(
                f"{broken[0]} is damaged or of another campaign; "
                "`ptsmc montecarlo` with the same options simulates it again"
            )
        return parts

    def check_scenario(self) -> None:
        """Raise RefusedError if the scenario in an existing folder has changed since the campaign began."""
        if self.stored_versions is not None and self.stored_versions.scenario_checksum != self.scenario_checksum:
            file = self.path / "scenario.toml"
            raise RefusedError(
                f"{file} was changed after the run, so the trials in {self.path} do not belong to it; undo the change, "
                f"or simulate the changed scenario in another folder with `ptsmc montecarlo {file} --out DIR`"
            )

    def intact_parts(self) -> list[Part]:
        """Return the parts of the rows. Raises RefusedError if a part is damaged, or if there are none."""
        parts = self.stored_parts()
        if not parts:
            raise RefusedError(f"{self.path} contains no trials yet; `ptsmc montecarlo` simulates them")
        return parts


def begin(folder: Folder, force: bool) -> None:
    """Create the folder, or check that it contains the same campaign. Raises RefusedError if it contains another one.

    force: discard the results of an existing campaign.
    """
    tables, path = parsing.dump(folder.scenario), folder.path
    versions = store.read_versions(path)  # files that no campaign wrote belong to the user
    has_c_code = custom.checksum_name(custom_parts.CONTROLLER) in versions
    earlier_sources = sources.list_files(path / C_FOLDER) if has_c_code else []
    if folder.controller is not None and earlier_sources != sources.list_files(path / C_FOLDER):
        raise RefusedError(f"--out is {path}, whose {C_FOLDER} contains C code of the user; allowed is another folder")
    if force and path.is_dir():
        for stored_rows in (folder.rows, folder.dry_run_rows):
            stored_rows.tidy(())
        if RUN_TABLE in versions:
            (path / TABLE).unlink(missing_ok=True)
    elif _contains_campaign(folder, tables):
        return

    def write_files(staging: Path) -> None:
        store.write_toml(staging / "scenario.toml", tables)
        store.write_json(staging / "versions.json", folder.versions)
        if folder.table is not None:
            parts = folder.campaign.ready.parts
            (staging / TABLE).write_bytes(rows.encode_parquet(folder.run_table.frame(parts)))
        if folder.controller is not None:
            sources.copy(folder.controller, staging / C_FOLDER)
        for file in earlier_sources:  # only now, because these files may be the source of the copy
            file.unlink(missing_ok=True)
        store.remove_summary(path)  # delete results of another campaign, or of fewer trials
        (path / campaign_theory.FILE).unlink(missing_ok=True)

    store.write_folder(path, write_files)


def _contains_campaign(folder: Folder, tables: Mapping[str, object]) -> bool:
    """Return whether the folder contains exactly this campaign.

    Raises RefusedError if the folder can neither be continued nor extended to this campaign.
    """
    path = folder.path
    store.check_folder(path, force=True)
    if not path.is_dir() or store.is_empty(path):
        return False
    checksum_names = [name for name in store.read_versions(path) if name == "metrics" or name.endswith("_sha256")]
    store.refuse_other_run(path, tables, {**dict.fromkeys(checksum_names), **folder.identity, **store.packages()})
    earlier = open_folder(path)
    earlier.check_scenario()
    if earlier.trials > folder.trials:
        raise RefusedError(
            f"--trials is {folder.trials}, but must be at least {earlier.trials}, the number of trials in {path}"
        )
    new_versions = msgspec.convert(folder.versions, CampaignVersions)  # this campaign may not exist yet
    same_rows = earlier.stored_versions == new_versions and earlier.identity == folder.identity
    is_same = earlier.trials == folder.trials and same_rows
    if not is_same or earlier.controller is None:
        return is_same
    key = custom_parts.CONTROLLER  # the folder's copy may be missing or changed
    return custom_parts.checksum(key, earlier.custom_code[key]) == earlier.checksums.get(custom.checksum_name(key))


def open_folder(path: Path) -> Folder:
    """Read the campaign of a folder without executing its custom code. Raises RefusedError if there is no campaign."""
    try:
        versions = store.read_versions(path)
        if versions.get("command", "montecarlo") != "montecarlo":
            raise RefusedError(
                f"{path} has results of `ptsmc {versions['command']}`, but must have results of `ptsmc montecarlo`"
            )
        stored = msgspec.convert(versions, CampaignVersions, strict=True)
        if stored.metrics is not None:
            systems.split_name(stored.metrics, CUSTOM)
        loaded = scenario.read(path / "scenario.toml")
    except ScenarioError as error:
        raise RefusedError(f"{path} contains a campaign, but its scenario cannot be read: {error}") from None
    except RefusedError:
        raise
    except (ValueError, msgspec.ValidationError):
        raise RefusedError(
            f"{path} is not a campaign, or its versions.json is damaged; allowed is a folder of `ptsmc montecarlo`"
        ) from None
    checksums = {name: value for name, value in versions.items() if name.endswith("_sha256") and isinstance(value, str)}
    return Folder(
        path=path,
        scenario=loaded,
        seed=stored.seed,
        trials=stored.trials,
        custom_metrics=stored.metrics,
        bits=stored.precision,
        stored_versions=stored,
        checksums=checksums,
        trusted=False,
        table_name=stored.run_table,
        table=None if stored.run_table is None else run_tables.read(path / TABLE, "the run table"),
        controller=path / C_FOLDER if custom.checksum_name(custom_parts.CONTROLLER) in checksums else None,
    )


def rebuild_campaign(path: str, key: str) -> tuple[Campaign, Rows]:
    """Rebuild a campaign and its rows in another process that can read the folder, see `Folder.recipe`.

    The key includes the scenario and the checksums. Matching keys therefore mean that this process executes the code
    that the user trusted when the campaign began. Raises RefusedError if the folder contains another campaign.
    """
    folder = open_folder(Path(path))
    if folder.rows.key.hex() != key:
        raise RefusedError(f"{path} contains another campaign on this machine than on the machine that started it")
    folder = replace(folder, trusted=True)
    return folder.campaign, folder.rows


def simulate(
    folder: Folder,
    shard: tuple[int, int],
    report: Callable[[Tally], None],
    simulate_remotely: Callable[[Folder, list[Block]], Iterator[tuple[Part, int]]] | None = None,
    trials: int | None = None,
) -> None:
    """Simulate the missing trials, and compute their lower bound and margins if these are missing.

    Damaged parts are reported, renamed and simulated again.

    Args:
        folder: the campaign.
        shard: (i, n) simulates the i-th of n shards, i from 1 to n.
        report: called with the progress after every part.
        simulate_remotely: simulates parts on other machines; None: this process simulates them.
        trials: simulate only the first trials up to this number; None: all of them.
    """
    campaign_theory.prepare(folder)
    trials = folder.trials if trials is None else trials
    parts, broken = folder.rows.parts()
    for path in broken:
        renamed = path.with_name(path.name + ".damaged")
        with contextlib.suppress(FileNotFoundError):  # another shard may have renamed the part
            os.replace(path, renamed)
        message = "is damaged and is simulated again" if rows.has_part_name(path) else "is no part of a campaign"
        print(f"ptsmc: {path} {message}; it is kept as {renamed.name}", file=sys.stderr)
    is_only_writer = shard == (1, 1) and simulate_remotely is None
    if is_only_writer:  # otherwise other processes may be writing into the folder
        folder.rows.tidy(parts)
    blocks = running.missing_parts(parts, trials, shard)
    if simulate_remotely:
        finished_parts = simulate_remotely(folder, blocks)
    else:
        finished_parts = running.make_parts(folder.campaign.simulate, folder.rows, blocks)
    running.report_progress(finished_parts, running.count_progress(parts, trials, blocks), report)
    if is_only_writer:
        folder.rows.tidy(folder.rows.parts()[0])
    campaign_theory.write_missing(folder)


def write_run_table(folder: Folder, report: Callable[[Tally], None]) -> None:
    """Write the dispersions of each trial without simulating it (`ptsmc montecarlo --dry-run`)."""
    parts, _ = folder.dry_run_rows.parts()
    folder.dry_run_rows.tidy(parts)
    blocks = running.missing_parts(parts, folder.trials)
    finished_parts = running.make_parts(folder.campaign.draw, folder.dry_run_rows, blocks)
    running.report_progress(finished_parts, running.count_progress(parts, folder.trials, blocks), report)


def write_trial_count(folder: Folder, trials: int) -> Folder:
    """Return the campaign with this final number of trials, and write the number to `versions.json`."""
    final = replace(folder, trials=trials)
    store.write_json(folder.path / "versions.json", final.versions)
    return final
