import pytest

from tests.agents.policies import save


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for seed in range(2):
        save(folder / "primary" / f"pl-{seed}" / "best.zip", seed=seed)
        lines = "update,steps,validation,validation_drawn", "0,0,0.3,", "1,50,,", "2,100,0.2,0.25"
        (folder / "primary" / f"pl-{seed}" / "progress.csv").write_text("\n".join(lines) + "\n")
    save(folder / "other" / "best.zip", bandwidth=3)
    return folder
