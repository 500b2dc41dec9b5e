"""What is left out of MuJoCo's steps for speed changes none of them, and comes back."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch

from sb3_rpto.effects import Drive, Simulation
from sb3_rpto.effects.engine import _clock, lean, untimed

# MuJoCo says so of an attribute that gymnasium's HalfCheetah has
pytestmark = pytest.mark.filterwarnings("ignore:.*settotalmass")
TASKS = ("HalfCheetah-v5", "Hopper-v5", "InvertedDoublePendulum-v5", "Swimmer-v5", "Reacher-v5", "Ant-v5")
ISLAND, CONTACT = (int(flag) for flag in (mujoco.mjtDisableBit.mjDSBL_ISLAND, mujoco.mjtDisableBit.mjDSBL_CONTACT))


def assert_same_steps(model):
    """A rollout as a batch of the model as it is makes it, under random commands."""
    rng = np.random.default_rng(0)
    n, steps = 8, 60
    qpos = model.qpos0 + 0.05 * rng.standard_normal((n, model.nq))
    qvel = rng.standard_normal((n, model.nv))
    commands = rng.uniform(-1, 1, (n, steps, model.nu))
    batch = Batch(model, n, 1)
    batch.bind("qpos")[:], batch.bind("qvel")[:] = qpos, qvel
    plain = batch.rollout(steps, commands, record=("qpos", "qvel"))
    q, v = Simulation(model, [], 1).rollout(np.empty((n, 0)), qpos, qvel, Drive(commands))
    np.testing.assert_array_equal(q[:, 1:], plain["qpos"])
    np.testing.assert_array_equal(v[:, 1:], plain["qvel"])


@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("task", TASKS)
def test_lean_steps_are_the_models_own_to_the_last_bit(task, friction):
    """With contacts, limits and dry friction."""
    model = gym.make(task).unwrapped.model
    model.dof_frictionloss[:] = friction
    assert_same_steps(model)


@pytest.mark.parametrize("integrator", mujoco.mjtIntegrator.__members__.values())
@pytest.mark.parametrize("cone", mujoco.mjtCone.__members__.values())
@pytest.mark.parametrize("solver", mujoco.mjtSolver.__members__.values())
def test_so_they_are_whatever_the_model_is_solved_with(solver, cone, integrator):
    """Sliding contacts are solved once more, too."""
    model = gym.make("Hopper-v5").unwrapped.model
    model.dof_frictionloss[:] = 0.2
    model.opt.solver, model.opt.cone, model.opt.integrator = int(solver), int(cone), int(integrator)
    model.opt.noslip_iterations = 3
    assert_same_steps(model)


@pytest.mark.parametrize(
    ("task", "left_out"),
    [
        ("HalfCheetah-v5", ISLAND),
        ("InvertedDoublePendulum-v5", ISLAND | CONTACT),
        ("Reacher-v5", CONTACT),
        ("Pusher-v5", 0),
    ],
)
def test_what_is_left_out(task, left_out):
    """Islands of one tree, contacts that no bits allow; the given model stays as it is."""
    model = gym.make(task).unwrapped.model
    before = model.opt.disableflags
    assert lean(model).opt.disableflags == before | left_out
    assert model.opt.disableflags == before


@pytest.mark.parametrize(
    ("bits", "pair", "contact"),
    [
        ('contype="0" conaffinity="0"', "", False),
        ('contype="2" conaffinity="4"', "", False),
        ('contype="1" conaffinity="3"', "", True),
        ('contype="0" conaffinity="0"', '<contact><pair geom1="0" geom2="1"/></contact>', True),
    ],
)
def test_a_search_for_contacts_stays_where_one_may_be(bits, pair, contact):
    """By bits, or by a pair that needs none."""
    balls = "".join(f'<body pos="{i} 0 0"><freejoint/><geom name="{i}" size=".1" {bits}/></body>' for i in range(2))
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{balls}</worldbody>{pair}</mujoco>")
    assert bool(lean(model).opt.disableflags & CONTACT) is not contact


def test_the_clock_comes_back_after_an_error_and_for_nested_uses():
    """MjData.timer is the user's again."""
    usual = _clock().value
    assert usual, "MuJoCo's clock was not found"

    def stepped():
        model = gym.make("InvertedPendulum-v5").unwrapped.model
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data)
        return data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration

    def interrupted():
        with untimed(), untimed():
            assert _clock().value is None
            assert stepped() == 0
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        interrupted()
    assert _clock().value == usual
    assert stepped() > 0
