"""Places of scenes. A scene is one drive, and so it lies in one place.

If drives of two places have one scene name, their samples are taken for one drive: they share a
memory over frames, and a map of the drive mixes both places.
"""

from collections.abc import Iterable


def scenes_of_several_places(pairs: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Find the scenes whose samples lie in several places.

    Args:
        pairs: Scene and place (``map_name``) of each sample. An empty place is unknown.

    Returns:
        Names of the places, sorted, by the name of the scene.
    """
    places_of: dict[str, set[str]] = {}
    for scene, place in pairs:
        if place:
            places_of.setdefault(scene, set()).add(place)
    return {scene: sorted(places) for scene, places in places_of.items() if len(places) > 1}


def place_warnings(pairs: Iterable[tuple[str, str]]) -> list[str]:
    """Describe scenes whose samples lie in several places.

    Args:
        pairs: Scene and place (``map_name``) of each sample. Samples without a scene are single
            frames, and are left out.

    Returns:
        One line that names the first of these scenes, or no line if there are none.
    """
    scenes = scenes_of_several_places(pair for pair in pairs if pair[0])
    if not scenes:
        return []
    name = min(scenes)
    others = f" (and {len(scenes) - 1} more)" if len(scenes) > 1 else ""
    return [
        f"scene {name!r}{others} has samples of several places, {scenes[name]} (map_name): a scene "
        "is one drive, so give each drive a scene name that no other drive has"
    ]
