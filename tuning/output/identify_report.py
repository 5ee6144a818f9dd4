"""The report of an identification."""

from tuning.output.formats import format_number
from tuning.output.report import Report, Section, Table
from tuning.output.summaries import Designed, Identified, LogFit

NOTE = """mean square: of the innovations over their variance. White innovations have a mean square of 1 and no
autocorrelation."""


def build(summary: Identified) -> Report:
    """Return the report of `ptsmc identify`."""
    is_identified = summary.status == "identified"
    headline = "The model explains the telemetry" if is_identified else "The model is DOUBTFUL"
    sections = [Section("Estimates", [estimate_table(summary)]), Section("Logs", [log_table(summary)])]
    return Report(headline, "good" if is_identified else "bad", summary.verdict, sections)


def estimate_table(summary: Identified) -> Table:
    """Return the table of the estimated numbers."""
    rows = [
        (one.parameter, f"{one.estimate:.6g}", f"{one.std:.2g}", f"{one.lower:.5g} to {one.upper:.5g}",
         f"{one.start:.6g}", format_number(one.prior_std, ".2g", "none"), one.unit or "-")
        for one in summary.parameters
    ]  # fmt: skip
    for bias in summary.gyro_bias:
        for axis, value, std in zip("xyz", bias.estimate, bias.std, strict=True):
            name = f"gyro bias {axis} at the end of {bias.log}"
            interval = f"{value - 1.96 * std:.5g} to {value + 1.96 * std:.5g}"
            rows.append((name, f"{value:.6g}", f"{std:.2g}", interval, "-", "-", "rad/s"))
    head = ("parameter", "estimate", "1 sigma", "95 % interval", "scenario", "prior 1 sigma", "unit")
    return Table(head, rows)


def log_table(summary: Identified) -> Table:
    """Return the table of the logs and of their prediction errors."""

    def log_row(fit: LogFit, use: str) -> tuple[str, ...]:
        largest = max((abs(value or 0.0) for value in fit.largest_autocorrelation.values()), default=0.0)
        numbers = (
            f"{fit.duration:.4g}",
            str(fit.readings),
            str(fit.outliers),
            f"{fit.mean_square:.4g}",
            f"{largest:.2g}",
        )
        return fit.log, use, *numbers, "yes" if fit.white else "NO"

    rows = [log_row(one, "estimation") for one in summary.logs] + [
        log_row(one, "validation") for one in summary.validation
    ]
    head = ("log", "use", "duration [s]", "readings", "outliers", "mean square", "autocorrelation", "white")
    return Table(head, rows, NOTE)


def build_design(summary: Designed) -> Report:
    """Return the report of `ptsmc identify --design`."""
    rows = [
        (
            str(one["parameter"]),
            *(f"{one[key]:.3g}" for key in ("value", "expected_std", "plain_std")),
            str(one["unit"]),
        )
        for one in summary.parameters
    ]
    table = Table(
        ("parameter", "scenario", "expected 1 sigma", "after plain slews", "unit"), rows,
        "Plain slews: one about each axis, one after another, within the same limits and time.",
    )  # fmt: skip
    lines = ["send the torque in profile.csv, and record attitude, rate and torque for ptsmc identify"]
    headline = f"Proposed a manoeuvre of {summary.duration:.4g} s"
    return Report(headline, "calm", [*lines, *summary.undetermined], [Section("Expected accuracy", [table])])
