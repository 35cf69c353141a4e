"""The reference profiles of the package, from the plan `profile-v1`.

    python docs/results/profiles.py PPO "PPO (gamma 0)" linear constant       # minutes
    python docs/results/profiles.py TD3 SAC --minutes 90                      # hours, in parts
    python docs/results/profiles.py "TD3 (gamma 0)" "SAC (gamma 0)" --minutes 90

Agents are in JAX. The same command continues from the results in the folder (`--folder`, by default
runs/profiles, which is not in the repository), also after a kill; programs that run save their
state every three minutes. After `--minutes`, and after Ctrl-C, what has finished is written, so a
part is kept by committing `sme_registry/profiles/references/`. TD3 and SAC with γ = 0 run on the
default, the reward interval and foresight alone. A profile that the package lacks is shown nowhere.
The pages follow with `python docs/generate.py` and `python docs/figures.py profiles`.
"""

from __future__ import annotations

import argparse
import signal
from pathlib import Path

from sme_registry.errors import OptionError
from sme_registry.profiles.document import REFERENCES
from sme_registry.profiles.levels import AXES, TWO_LAYERS, plan_file
from sme_registry.profiles.run import profile_of, slug
from sme_registry.studies import run_study

SHORT = ("TD3 (gamma 0)", "SAC (gamma 0)")
SHORT_AXES = ("k-5", "shaping-scale-10")  # a level of each


def classes_of(name: str) -> tuple[str, ...]:
    """The levels that an algorithm is run on."""
    if name not in SHORT:
        return tuple(member.name for member in plan_file().plan.classes)
    levels = [level for axis in AXES if {*axis.levels} & {*SHORT_AXES} for level in axis.levels]
    return tuple(dict.fromkeys(("default", TWO_LAYERS, *levels)))


def main() -> None:
    """Run what is missing of each algorithm, and write its profile."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    file = plan_file()
    known = [algorithm.name for algorithm in file.plan.algorithms]
    parser.add_argument("names", nargs="+", choices=known, metavar="NAME", help=", ".join(known))
    parser.add_argument("--folder", default="runs/profiles", help="of the study")
    parser.add_argument("--minutes", type=int, default=0, help="stop after so many")
    parser.add_argument("--jobs", type=int, help="programs at once; default one per core")
    parser.add_argument("--out", type=Path, default=REFERENCES)
    options = parser.parse_args()
    if options.minutes:
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.alarm(60 * options.minutes)
    stopped = False
    for name in options.names:
        only = [f"algorithm={name}", *(f"class={each}" for each in classes_of(name))]
        try:
            if not stopped:
                run_study(file, options.folder, only=only, jobs=options.jobs)
        except KeyboardInterrupt as interrupt:
            print(interrupt)
            stopped = True
        try:
            profile = profile_of(options.folder, name, classes=classes_of(name))
        except OptionError as error:
            print(f"{name}: {error}")
            continue
        path = profile.write(options.out / f"{slug(name)}.json")
        print(f"{path}: {len(profile.rows)} of {profile.planned} runs")


if __name__ == "__main__":
    main()
