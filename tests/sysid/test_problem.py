"""What the search works on: room for delayed commands in shorter steps."""

import mujoco
import numpy as np
import pytest

from sb3_rpto.effects import Drive, Simulation
from sb3_rpto.sysid import Measurements
from sb3_rpto.sysid.problem.problem import make_room_for_delays
from sb3_rpto.sysid.settings import DEFAULTS
from sb3_rpto.sysid.shooting.windows import discretised

DELAYED = """<mujoco><option timestep="0.004"/><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size=".1"
    pos="0 0 -.4"/></body></worldbody><actuator><motor name="motor" joint="hinge" delay="0.02" nsample="5"/></actuator>
    </mujoco>"""
DATA = Measurements.from_tables(
    {"run": {"time": 0.01 * np.arange(60), "qpos.hinge": np.sin(np.arange(60) / 9), "ctrl.motor": np.zeros(60)}}
)


def first_motion(model: mujoco.MjModel) -> float:
    """Seconds between a command and the motion that it makes."""
    count = round(0.1 / model.opt.timestep)
    commands = np.repeat([0.0, 1.0], count)[None, :, None]
    still = np.zeros((1, 1))
    _, v = Simulation(model, [], 1).rollout(np.empty((1, 0)), still, still, Drive(commands, count))
    return float(np.flatnonzero(np.abs(v[0, :, 0]) > 0)[0] * model.opt.timestep)


@pytest.mark.parametrize("shorter", [1, DEFAULTS.problem.finer_steps])
def test_a_delay_lasts_in_the_shorter_steps_of_measured_data(shorter: int) -> None:
    spec = mujoco.MjSpec.from_string(DELAYED)
    compiled = spec.compile()
    compiled.dof_damping[0] = 0.3  # as an environment may have set it
    roomy = make_room_for_delays(spec, compiled, DATA)
    assert roomy.dof_damping[0] == 0.3
    model = discretised(roomy, DATA, fine=True)
    model.opt.timestep /= shorter
    assert 0.02 <= first_motion(model) <= 0.02 + model.opt.timestep + 1e-9
    assert first_motion(compiled) == first_motion(roomy) == pytest.approx(0.024)
    assert spec.actuators[0].nsample == 5


def test_where_nothing_tells_the_mjcf_the_samples_that_a_delay_takes_are_named() -> None:
    with pytest.raises(ValueError, match=r"'motor' is delayed by 0.02 s and holds nsample=5.*nsample=\"40\": write"):
        make_room_for_delays(None, mujoco.MjModel.from_xml_string(DELAYED), DATA)
    plain = mujoco.MjModel.from_xml_string(DELAYED.replace('delay="0.02" nsample="5"', ""))
    assert make_room_for_delays(None, plain, DATA) is plain
