"""FMUs in FMPy, and a master that steps a controller and a plant one after the other."""

import tempfile

import fmpy
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave


class Unit:
    """An FMU that FMPy has loaded from a file. Its variables are read and written by name.

    `unit` is its first instance, which all methods use by default; `period` is its step [s].
    """

    def __init__(self, file):
        self.described = fmpy.read_model_description(str(file))
        self.place = fmpy.extract(str(file), tempfile.mkdtemp(prefix="ptsmc-fmu-"))
        self.of = {v.name: v for v in self.described.modelVariables}
        self.three = self.described.fmiVersion.startswith("3")
        self.period = float(self.described.defaultExperiment.stepSize)
        self.unit = self.instance()

    def instance(self):
        """Return a new instance of the FMU, which is instantiated, but not initialised."""
        made = (FMU3Slave if self.three else FMU2Slave)(
            guid=self.described.guid, unzipDirectory=self.place, instanceName="unit",
            modelIdentifier=self.described.coSimulation.modelIdentifier,
        )  # fmt: skip
        made.instantiate()
        return made

    def _of_type(self, names, prefix, unit):
        """Return [(`unit.getFloat64` or the like, the names of variables of that type), ..].

        prefix: "get" or "set". unit: an instance of the FMU.
        """
        groups = {}
        for name in names:
            groups.setdefault(self.of[name].type, []).append(name)
        return [(getattr(unit, f"{prefix}{kind}"), found) for kind, found in groups.items()]

    def write(self, values, unit=None):
        """Set variables; values: a dict by name. unit: an instance, by default the first one."""
        for function, names in self._of_type(values, "set", unit or self.unit):
            function([self.of[name].valueReference for name in names], [values[name] for name in names])

    def read(self, names, unit=None):
        """Return the values of variables as a dict by name; unit: an instance, by default the first one."""
        found = {}
        for function, some in self._of_type(names, "get", unit or self.unit):
            found |= dict(zip(some, function([self.of[name].valueReference for name in some]), strict=True))
        return {name: found[name] for name in names}

    def begin(self, values=(), unit=None):
        """Initialise an instance; values: start values by name. unit: an instance, by default the first one."""
        unit = unit or self.unit
        if self.three:
            self.write(dict(values), unit)
            unit.enterInitializationMode()
        else:
            unit.setupExperiment()
            self.write(dict(values), unit)
            unit.enterInitializationMode()
        unit.exitInitializationMode()

    def step(self, k, unit=None):
        """Make step k, from time k `period`, of one control period; unit: an instance, by default the first one."""
        (unit or self.unit).doStep(currentCommunicationPoint=k * self.period, communicationStepSize=self.period)

    def names(self, causality):
        """Return a list of the names of all variables with this causality, such as "input"."""
        return [v.name for v in self.described.modelVariables if v.causality == causality]


def closed_loop(loop, count, parameters=()):
    """Return [(outputs of the plant, commands of the controller), ..] of `count` periods, two dicts for each sample.

    loop: the units of controller and plant. parameters: start values of the plant.
    """
    controller, plant = loop
    plant.begin(parameters)
    readings = plant.read(plant.names("output"))
    controller.begin({name: readings[name] for name in controller.names("parameter") if name in readings})
    given, sent = controller.names("input"), plant.names("input")
    rows = []
    for k in range(count):
        controller.write({name: readings[name] for name in given})
        controller.step(k)
        commands = controller.read(controller.names("output"))
        rows.append((readings, commands))
        plant.write({name: commands[name] for name in sent})
        plant.step(k)
        readings = plant.read(plant.names("output"))
    return rows
