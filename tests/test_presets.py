import pytest

from sb3_rpto.presets import preset_names, resolve_preset


def test_the_papers_table():
    table = {"Ant": (5, 1.0), "HalfCheetah": (1, 0.5), "Hopper": (2, 1.0), "Walker2d": (1, 0.5), "Swimmer": (20, 0.5)}
    for task, (updates, floor) in table.items():
        values = resolve_preset("paper", "ensemble", f"{task}-v5", ())
        assert (values["gradient_steps"], values["weight_floor"]) == (updates, floor)
        assert values["real_ratio"] == 0
        assert values["rollout_start"] == "target"
        assert values["dynamics_kwargs"]["max_steps"] == values["model_train_freq"]  # replay ratio 1


def test_the_authors_run_configuration():
    values = resolve_preset("author", "ensemble", "Walker2d-v5", ())
    assert (values["gradient_steps"], values["model_train_freq"], values["dynamics_kwargs"]["patience"]) == (5, 250, 1)
    assert resolve_preset("author", "ensemble", "Hopper-v4", ())["model_train_freq"] == 500
    assert resolve_preset("author", "ensemble", "rpto/Swimmer-v0", ())["model_train_freq"] == 100


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("backend", ["real", "ensemble", "physical"])
def test_an_unknown_environment_gets_the_documented_default(preset, backend):
    unknown = resolve_preset(preset, backend, "SomebodysRobot-v3", ())
    assert unknown == resolve_preset(preset, backend, None, ())
    assert {"gradient_steps", "source_steps", "buffer_size", "real_ratio"} <= unknown.keys()


def test_what_the_user_passed_wins():
    assert "gradient_steps" not in resolve_preset("paper", "ensemble", "Ant-v5", {"gradient_steps"})


def test_an_unknown_preset_names_the_others():
    with pytest.raises(ValueError, match="paper"):
        resolve_preset("papre", "ensemble", None, ())


@pytest.mark.parametrize("preset", preset_names())
@pytest.mark.parametrize("backend", ["real", "ensemble", "physical", "mujoco", "residual"])
@pytest.mark.parametrize("task", ["Ant", "HalfCheetah", "Hopper", "Walker2d", "Swimmer"])
def test_the_networks_numbers_of_a_task_are_for_networks_alone(preset, backend, task):
    values, everywhere = (resolve_preset(preset, backend, name, ()) for name in (f"{task}-v5", None))
    assert not {"any", "real", "ensemble", "physical", "mujoco", "residual"} & values.keys()
    if backend != "ensemble":
        assert values.get("dynamics_kwargs") == everywhere.get("dynamics_kwargs")
        assert values.get("model_train_freq") == everywhere.get("model_train_freq")
