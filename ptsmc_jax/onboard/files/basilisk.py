"""The exported controller as a module of Basilisk. `make shared` builds the library that it loads.

>>> computer = FlightComputer("out/controller")
>>> computer.starInMsg.subscribeTo(star_tracker.sensorOutMsg)  # or navInMsg, with attitude and rate
>>> computer.gyroInMsg.subscribeTo(imu.sensorOutMsg)
>>> computer.wheelsInMsg.subscribeTo(factory.getConfigMessage())  # with reaction wheels
>>> computer.speedsInMsg.subscribeTo(wheels.rwSpeedOutMsg)
>>> wheels.rwMotorCmdInMsg.subscribeTo(computer.motorsOutMsg)  # without wheels: torqueOutMsg
>>> simulation.AddModelToTask("flight software", computer)  # a task with the control period, after the dynamics
"""

import ctypes
import json
from pathlib import Path

import numpy as np
from Basilisk.architecture import messaging, sysModel  # pyright: ignore[reportMissingImports]

READ = ("t", "attitude", "attitude_valid", "rate", "wheel_momentum")  # inputs that the module provides


class FlightComputer(sysModel.SysModel):
    """Reads the sensors, calls the C, and writes the torque on the body and on the wheels, once in each update."""

    def __init__(self, folder):
        super().__init__()
        columns = json.loads((Path(folder) / "controller.json").read_text())["columns"]
        self.inputs, self.outputs = columns["in"], columns["out"]
        other = sorted({name.partition("[")[0] for name in self.inputs} - set(READ))
        if other:
            raise ValueError(f"the controller has the input {other[0]}, but this module has messages for {READ} only")
        self.c = ctypes.CDLL(str((Path(folder) / "controller.so").resolve()))
        self.c.controller_new.restype = ctypes.c_void_p
        self.c.controller_free.argtypes = [ctypes.c_void_p]
        self.state, self.start, self.begun = None, None, 0  # start: row of the state before the first sample, or None
        self.status, self.out = 0, np.zeros(len(self.outputs))  # of the last sample
        self.navInMsg, self.starInMsg = messaging.NavAttMsgReader(), messaging.STSensorMsgReader()
        self.gyroInMsg, self.speedsInMsg = messaging.IMUSensorMsgReader(), messaging.RWSpeedMsgReader()
        self.wheelsInMsg = messaging.RWArrayConfigMsgReader()
        self.motorsOutMsg, self.torqueOutMsg = messaging.ArrayMotorTorqueMsg(), messaging.CmdTorqueBodyMsg()

    def Reset(self, now):
        """Begin a run at a time [ns]."""
        self.c.controller_free(self.state)
        self.state, self.begun = ctypes.c_void_p(self.c.controller_new()), now
        if self.start is not None:
            self.c.controller_set(self.state, _doubles(self.start))

    def UpdateState(self, now):
        """Take a sample at a time [ns]."""
        if self.starInMsg.isLinked():
            attitude, valid = np.roll(self.starInMsg().qInrtl2Case, -1), self.starInMsg.isWritten()
        else:
            mrp = np.array(self.navInMsg().sigma_BN)
            attitude, valid = np.append(2.0 * mrp, 1.0 - mrp @ mrp) / (1.0 + mrp @ mrp), self.navInMsg.isWritten()
        linked = self.gyroInMsg.isLinked()
        rate = np.array(self.gyroInMsg().AngVelPlatform if linked else self.navInMsg().omega_BN_B)
        values = {"t": [1e-9 * (now - self.begun)], "attitude": attitude, "attitude_valid": [valid], "rate": rate}
        if self.wheelsInMsg.isLinked():
            known = self.wheelsInMsg()
            axes, spin = np.reshape(known.GsMatrix_B, (-1, 3))[: known.numRW], np.array(known.JsList)[: known.numRW]
            values["wheel_momentum"] = spin * (np.array(self.speedsInMsg().wheelSpeeds)[: known.numRW] + axes @ rate)
        names = dict.fromkeys(name.partition("[")[0] for name in self.inputs)
        row = np.concatenate([values[name] for name in names]).astype(float)
        self.status = self.c.controller_step(self.state, _doubles(row), _doubles(self.out))
        torque, motors = messaging.CmdTorqueBodyMsgPayload(), messaging.ArrayMotorTorqueMsgPayload()
        torque.torqueRequestBody = self.values("torque" if "torque[0]" in self.outputs else "command").tolist()
        motors.motorTorque = (-self.values("wheel_torque")).tolist()  # on the wheel
        self.torqueOutMsg.write(torque, now, self.moduleID)
        self.motorsOutMsg.write(motors, now, self.moduleID)

    def values(self, name):
        """Return an output of the last sample, such as "d_hat"."""
        return self.out[[k for k, column in enumerate(self.outputs) if column.partition("[")[0] == name]]


def _doubles(row):
    return row.ctypes.data_as(ctypes.c_void_p)
