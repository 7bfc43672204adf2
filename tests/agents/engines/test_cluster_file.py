"""The cluster file of the examples, by Ray's own schema."""

import copy
import json
from pathlib import Path

import pytest

ray = pytest.importorskip("ray")
jsonschema = pytest.importorskip("jsonschema")
yaml = pytest.importorskip("yaml")

CLUSTER = yaml.safe_load((Path(__file__).parents[3] / "examples" / "cluster.yaml").read_text())
SCHEMA = json.loads((Path(ray.__file__).parent / "autoscaler" / "ray-schema.json").read_text())


def test_ray_takes_the_cluster_file():
    jsonschema.validate(CLUSTER, SCHEMA)
    assert len(CLUSTER["provider"]["worker_ips"]) == CLUSTER["max_workers"]


@pytest.mark.parametrize("key", ["cluster_name", "provider"])
def test_the_schema_would_refuse_one_without_a_part(key):
    broken = copy.deepcopy(CLUSTER)
    del broken[key]
    with pytest.raises(jsonschema.ValidationError, match=key):
        jsonschema.validate(broken, SCHEMA)


def test_the_schema_would_refuse_a_misspelt_key():
    with pytest.raises(jsonschema.ValidationError, match="setup_comands"):
        jsonschema.validate({**CLUSTER, "setup_comands": []}, SCHEMA)
