# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From requirements to gains
#
# An engineer says what must hold, here no torque above 0.5 N m in any trial, from attitudes 20 to 140 degrees away, and
# asks for the smallest error after t_f. The search differentiates through the flown trials, by every gain of the law: K1
# and the width of the smooth sign too, so what is differentiated is what flies. The proof is on *fresh* trials,
# which the search never saw, on the *flight clock*: samples at whole periods, wherever t_f and the hand-over fall.

# %%
from ptsmc_jax.configure import configure

configure()

from IPython.display import display

import ptsmc_jax as ptsmc
from ptsmc_jax.explore import Figures
from ptsmc_jax.figures import study_plots
from tuning.output import terminal
from tuning.search import gains
from tuning.studies import pareto, stability, trades, tune_files, tuner

flight = ptsmc.read("../scenarios/first_flight.toml")
small = ptsmc.replace(flight, tune={"trials": 16, "starts": 3, "steps": 30})  # less than the default, for a quick look

# %% [markdown]
# `ptsmc tune scenarios/first_flight.toml` is this with 64 trials and 12 starts. The table sets the tuned gains beside the
# paper's on 1 000 fresh trials. Below it stands what to know before one trusts them: the interval of the gain, the worst
# case that a search inside the dispersions finds (a few percent beyond the limit, where no drawn trial was: tune with
# `worst_case = true` if that must not be), and whether the slopes were right.

# %%
tuned = tuner.tune(small, seed=0)
terminal.tuning(tune_files.summary(tuned), "out/tune-first_flight", "done")

# %% [markdown]
# Each line is a start on its way to the optimum next to it. Grey is beyond a limit, blue keeps it; the gains below the
# goal show into which valley each start went. From the best end the search goes on to more digits.

# %%
made = tune_files.figures_of(small, tuned)
Figures({"history": made["history"]})

# %% [markdown]
# What each gain does: by how many percent a metric changes for one percent of the gain. One percent of η costs two
# percent of torque and buys some of the error: nothing but the limit on the torque stops it. The others are different:
# one percent of them changes the error by less than a hundredth of a percent. The best values of delta, l and K1 lie
# inside the bounds; the sign's width ended on its lower one, where it hardly counts.

# %%
Figures({"sensitivities": made["sensitivities"]})

# %% [markdown]
# Every fresh trial is a point. With the paper's gains many trials ask for more than the limit, 0.58 N m in the mean, and
# their errors are the large ones; with the tuned gains all of them stay below it.

# %%
Figures({"tradeoff": made["tradeoff"]})

# %% [markdown]
# How much accuracy does torque buy? The front, here of few points, each judged on fresh trials: nothing that was found is
# better in both. The knee is where the front bends most; `ptsmc pareto` draws it with twenty points.

# %%
front = pareto.trace(trades.Torque(small, points=4), 0)
Figures({"front": study_plots.front(front.points, front.labelled(), 0.5, ("-", "N m"))})

# %% [markdown]
# Click a point: its gains, its margins in hold and before the hand-over, and one flight with it. What stands below is the knee; the
# front that can be clicked follows where `ipywidgets`, `plotly` and `anywidget` are installed.


# %%
def chosen(point):
    flown = gains.in_scenario(small, point.gains)
    print("gains:", ", ".join(f"{name} = {value:.4g}" for name, value in point.gains.items()))
    for where, least in stability.worst(ptsmc.study(flown)).items():
        print(where, {name: least[name] for name in ("gain_margin", "phase_margin")}, "dB and deg; None: unlimited")
    return ptsmc.simulate(flown, trial=7).plot("error", "torque")


def clicked(trace, places, state):
    with below:
        below.clear_output(wait=True)
        display(chosen(front.points[places.point_inds[0]]))


display(chosen(next(point for point in front.points if point.knee)))
try:
    from ipywidgets import Output, VBox
    from plotly import graph_objects

    drawn = graph_objects.FigureWidget(
        graph_objects.Scatter(
            x=[one.peak for one in front.points], y=[one.rms for one in front.points], mode="markers"
        ),
        {"xaxis_title": "peak torque [N m]", "yaxis_title": "RMS window error [-]", "yaxis_type": "log"},
    )
    below = Output()
    drawn.data[0].on_click(clicked)
    display(VBox([drawn, below]))
except ImportError:
    pass

# %% [markdown]
# One command, and the accuracy that noise had taken is back at a fraction of the torque; a page to send comes from
# `ptsmc report` on its folder. Do the gains hold when more than the attitude varies? That is the next notebook.
