"""Motor torques told from commands and state are MuJoCo's own."""

import mujoco
import numpy as np
import pytest

from sb3_rpto.effects.actuation import joint_torque, memoryless, motors
from sb3_rpto.effects.batch import LiveSimulation, MujocoBatch

XML = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1" pos="0.2 0 0"/>
<body pos="0.4 0 0"><joint name="b" type="slide"/><geom size="0.1"/></body></body></worldbody>
<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed></tendon><actuator>{}</actuator></mujoco>"""
ACTUATORS = {
    "motor": '<motor joint="a" gear="3" ctrlrange="-1 1"/>',
    "servo": '<position joint="a" kp="20" kv="2" forcerange="-5 5" gear="1.5"/>',
    "affine gain": '<general joint="a" gaintype="affine" gainprm="2 0.5 -0.3" biastype="affine" biasprm="0.1 -2 0.2"/>',
    "two": '<motor joint="a" gear="3"/><velocity joint="a" kv="0.5"/><motor joint="b"/>',
}


@pytest.mark.parametrize("kind", ACTUATORS)
@pytest.mark.parametrize("limit", ["", 'actuatorfrcrange="-1.5 2"'])
def test_torque_is_mujocos(kind: str, limit: str) -> None:
    xml = XML.format(ACTUATORS[kind]).replace('name="a"', f'name="a" {limit}')
    model = mujoco.MjModel.from_xml_string(xml)
    on = motors(model, 0)
    assert on is not None
    rng = np.random.default_rng(0)
    batch = MujocoBatch(model, 50, 1)
    batch.qpos[:], batch.qvel[:] = rng.normal(size=(2, 50, 2))
    batch.ctrl[:] = 2 * rng.normal(size=(50, model.nu))
    got = joint_torque(batch, on, 0, 0)
    batch.engine.forward()
    np.testing.assert_allclose(got, batch.actuation[:, 0], rtol=1e-12, atol=1e-12)
    live = LiveSimulation(model, mujoco.MjData(model))
    live.qpos[:], live.qvel[:], live.ctrl[:] = batch.qpos[0], batch.qvel[0], batch.ctrl[0]
    np.testing.assert_allclose(joint_torque(live, on, 0, 0), got[:1], rtol=1e-12)


@pytest.mark.parametrize(
    "actuator",
    ['<general joint="a" dyntype="filter" dynprm="0.1"/>', '<motor tendon="t"/>', '<muscle joint="a"/>'],
)
def test_memory_and_tendons_fall_back_to_the_substep_before(actuator: str) -> None:
    model = mujoco.MjModel.from_xml_string(XML.format(actuator))
    assert not memoryless(model, 0)
    assert motors(model, 0) is None
    batch = MujocoBatch(model, 1, 1)
    batch.ctrl[:] = 1.0
    batch.engine.step()
    batch.engine.step()
    np.testing.assert_array_equal(joint_torque(batch, None, 0, 0), batch.actuation[:, 0])
