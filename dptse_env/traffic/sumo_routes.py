"""Vehicles and their routes in SUMO's XML."""

from xml.etree import ElementTree

from dptse_env.traffic.corridor import Corridor
from dptse_env.traffic.scenario import MAINLINE, Scenario
from dptse_env.traffic.sumo_network import ramp_edges


def routes_xml(corridor: Corridor, scenario: Scenario) -> bytes:
    """Return SUMO's route file of a scenario, on the network that is made for its corridor."""
    root = ElementTree.Element("routes")
    classes = {each.name: each.attributes(corridor.drivers) for each in corridor.vehicle_classes}
    classes = classes or {"car": corridor.drivers.attributes()}
    for name, attributes in classes.items():
        ElementTree.SubElement(root, "vType", {"id": name, **attributes})
    names = list(classes)
    for origin in range(MAINLINE, corridor.n_on_ramps):
        for end in range(MAINLINE, corridor.n_off_ramps):
            first = 0 if origin == MAINLINE else corridor.on_ramps[origin]
            last = corridor.n_mainline if end == MAINLINE else corridor.off_ramps[end]
            if first >= last:
                continue
            edges = (
                *_entry_edges(corridor, origin),
                *(f"main_{i}" for i in range(first, last)),
                *_exit_edges(corridor, end),
            )
            ElementTree.SubElement(root, "route", id=f"{origin}:{end}", edges=" ".join(edges))
    for vehicle, (departure, origin, end, kind) in enumerate(
        zip(scenario.departures, scenario.origins, scenario.exits, scenario.classes, strict=True)
    ):
        ElementTree.SubElement(
            root,
            "vehicle",
            id=str(vehicle),
            type=names[kind],
            route=f"{origin}:{end}",
            depart=f"{departure:.3f}",
            # As fast as is safe, on the lane that suits the route, and by default at the start of
            # the boundary segment, so that it is measured there. About 4,700 veh/h can then enter
            # the paper's mainline; others queue outside. With `departPos="last"` 9 % more can
            # enter, but vehicles start at the far end of an empty boundary segment.
            departSpeed="max",
            departLane="best",
        )
    return ElementTree.tostring(root)


def _entry_edges(corridor: Corridor, origin: int) -> list[str]:
    if origin == MAINLINE:
        return ["upstream"]
    name = f"on_{origin}"
    return [f"before_{name}", *ramp_edges(name, corridor.on_ramp_segments[origin])]


def _exit_edges(corridor: Corridor, end: int) -> list[str]:
    if end == MAINLINE:
        return ["downstream"]
    name = f"off_{end}"
    return [*ramp_edges(name, corridor.off_ramp_segments[end]), f"after_{name}"]
