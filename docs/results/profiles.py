"""The reference profiles of the package, from the plan `profile-v1`.

    python docs/results/profiles.py PPO "PPO (gamma 0)" linear constant       # minutes
    python docs/results/profiles.py TD3 SAC --minutes 90                      # hours, in parts
    python docs/results/profiles.py "TD3 (gamma 0)" "SAC (gamma 0)" --minutes 90

Agents are in JAX. The same command continues from the results in the folder (`--folder`, by default
runs/profiles, which is not in the repository), also after a kill; programs that run save their
state every three minutes. After `--minutes`, and after Ctrl-C, what has finished is written, so a
part is kept by committing it: a whole profile is in `sme_registry/profiles/references/`, a part of
one in `unfinished-profiles/` beside this script, and no run of either is run again. TD3 and SAC
with γ = 0 run on the levels of the reward interval, complexity and foresight alone. The pages
follow with `python docs/generate.py` and `python docs/figures.py profiles`.
"""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from sme_registry import Profile
from sme_registry.profiles.document import AXES, REFERENCES, TWO_LAYERS, plan_file
from sme_registry.profiles.run import part_of_profile, slug
from sme_registry.studies import run_study

PARTS = Path(__file__).parent / "unfinished-profiles"
SHORT = ("TD3 (gamma 0)", "SAC (gamma 0)")
SHORT_AXES = ("k-5", "complexity-10", "shaping-scale-10")  # a level of each


def classes_of(name: str) -> tuple[str, ...]:
    """The levels that an algorithm is run on."""
    if name not in SHORT:
        return tuple(member.name for member in plan_file().plan.classes)
    levels = [level for axis in AXES if {*axis.levels} & {*SHORT_AXES} for level in axis.levels]
    return tuple(dict.fromkeys(("default", TWO_LAYERS, *levels)))


def joined(profiles: list[Profile]) -> Profile:
    """The last one, with the rows of all, which are of one plan."""
    last = profiles[-1]
    rows = {(row.class_name, row.run): row for profile in profiles for row in profile.rows}
    order = sorted(rows, key=lambda place: (last.classes.index(place[0]), place[1]))
    versions = {name: version for each in profiles for name, version in each.versions.items()}
    return last.model_copy(
        update={"rows": tuple(rows[place] for place in order), "versions": versions}
    )


def main() -> None:
    """Run what is missing of each algorithm, and write its profile."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    file = plan_file()
    known = [algorithm.name for algorithm in file.plan.algorithms]
    parser.add_argument("names", nargs="+", choices=known, metavar="NAME", help=", ".join(known))
    parser.add_argument("--folder", default="runs/profiles", help="of the study")
    parser.add_argument("--minutes", type=int, default=0, help="stop after so many")
    parser.add_argument("--jobs", type=int, help="programs at once; default one per core")
    parser.add_argument("--lanes", type=int, help="most runs of a program; fewer are filled up")
    parser.add_argument("--out", type=Path, default=REFERENCES)
    options = parser.parse_args()
    if options.minutes:
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.alarm(60 * options.minutes)
    stopped = False
    for name in options.names:
        places = [folder / f"{slug(name)}.json" for folder in (options.out, PARTS)]
        earlier = [Profile.read(place) for place in places if place.exists()]
        earlier = [profile for profile in earlier if profile.plan_digest == file.digest]
        known_runs = {(row.class_name, row.run) for profile in earlier for row in profile.rows}
        missing: dict[tuple[int, ...], list[str]] = {}  # the classes that lack the same runs
        for each in classes_of(name):
            lacks = tuple(run for run in range(file.plan.seeds) if (each, run) not in known_runs)
            missing.setdefault(lacks, []).append(each)
        missing.pop((), None)
        try:
            for runs, classes in [] if stopped else missing.items():
                # Two classes at once, so that a part has whole classes.
                for first in range(0, len(classes), 2):
                    only = [f"algorithm={name}", *(f"run={run}" for run in runs)]
                    only += [f"class={each}" for each in classes[first : first + 2]]
                    sizes = {"jobs": options.jobs, "lanes": options.lanes}
                    run_study(file, options.folder, only=only, **sizes)
        except KeyboardInterrupt as interrupt:
            print(interrupt)
            stopped = True
        if not Path(options.folder).exists():
            continue
        new = part_of_profile(options.folder, name, classes=classes_of(name))
        if not new.rows:
            print(f"{name}: the folder has no finished run")
            continue
        profile = joined([*earlier, new])
        is_whole = len(profile.rows) == profile.planned
        path = profile.write(places[0] if is_whole else places[1])
        if is_whole:
            places[1].unlink(missing_ok=True)
        print(f"{path}: {len(profile.rows)} of {profile.planned} runs")


if __name__ == "__main__":
    main()
