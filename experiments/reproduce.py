"""Make all papers' tables, figures and claims in results/, and check those that are there."""

import os
import re
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path

from experiments.audit import audit
from experiments.judging.built import (
    Built,
    State,
    dependencies_of,
    list_built,
    note_built,
    table_dependencies,
)
from experiments.judging.claim import Claim, Verdict
from experiments.judging.claims_file import (
    note_provenance,
    read_claims,
    read_verdicts,
    write_claims,
    write_verdicts,
)
from experiments.judging.folders import LOGS, OWN, STUDIES, SWEEPS, findings
from experiments.judging.folders import part as _part
from experiments.judging.jobs import in_parallel
from experiments.judging.logs import DATA, why_missing
from experiments.judging.results import Profile, Results, reproduce_command
from experiments.judging.sentences import Conclusion, conclude
from experiments.report.contents import write_report
from experiments.runs.console import pluralize, progress, show, warn
from experiments.runs.dependencies.recorder import digest_of_all, recorded
from experiments.runs.evaluate import limit_blas
from experiments.runs.paths import results, short
from experiments.viewing.style import save_figure
from sim.errors import InputError, nearest, require

# Tables that a command of their own makes: on other seeds, from which parameters were chosen, and
# over real logs
_APART = ("_tuning", "peers_logs")
_AGAIN = "reproduced"  # folder in the results
Items = dict[str, tuple[dict[str, str], float]]  # dependencies and seconds, by name


def check_results(minutes: float = 2.0) -> bool:
    """Check the judged results: audit the tables, and make from them all that is made of them.

    Figures, claims and the report go to `results/reproduced`, which is not committed.

    Returns
    -------
    bool
        Whether all rows made again are equal, and all verdicts the judged ones.
    """
    equal = audit(minutes, None, seed=0)
    place = results() / _AGAIN
    shutil.rmtree(place, ignore_errors=True)
    for kind in ("tables", "arrays", "figures"):
        shutil.copytree(results() / kind, place / kind)
    for name in ("provenance.json", "claims.csv", "verdicts.csv"):
        shutil.copy(results() / name, place / name)
    jobs = [(place, study) for study in STUDIES if _can_be_drawn(place, study)]
    with progress("figures and claims", 1.0) as on_progress:
        made = dict(zip((s for _, s in jobs), in_parallel(_again, jobs, on_progress), strict=True))
    judged = read_verdicts(results() / "verdicts.csv").set_index("id")
    for study, (n_figures, conclusions, claims) in made.items():
        _write(claims, conclusions, place, study, Profile.FULL)
        said = []
        for each in conclusions:
            row = judged.loc[each.id] if each.id in judged.index else None
            same = row is not None and (row["verdict"], row["sentence"]) == (
                str(each.verdict),
                each.sentence,
            )
            equal &= same
            said.append(f"{each.id} {each.verdict.label}" + " (not as judged)" * (not same))
        show(f"{study}: {pluralize(n_figures, 'figure')}; {', '.join(said) or 'judges no claim'}")
    show(f"{short(write_report(place))} has all of it; open it in a browser")
    return equal


def _can_be_drawn(place: Path, study: str) -> bool:
    """Whether a study's tables are here, and of real logs what is drawn of them."""
    drawn = study not in LOGS or any((place / "arrays").glob(f"{study}_*.npz"))
    return drawn and any((place / "tables").glob(f"{study}_*.csv"))


def _again(place: Path, study: str) -> tuple[int, list[Conclusion], list[Claim]]:
    """Draw a study's figures and judge its claims from its tables; the number of figures."""
    made = Results(place, study)
    with made.blaming_files():
        n_figures = len(_draw(made))
        claims, conclusions = ([], []) if study in OWN else judgement(made)
    return n_figures, conclusions, claims


def reproduce(only: str | None = None, part: str | None = None) -> None:
    """Run the studies, judge the claims, draw the figures, write the report.

    Parameters
    ----------
    only
        A study's short name, or None for all.
    part
        Of that study, as for `reproduce_part`; None for all of it.
    """
    _check_claims()
    lines = []
    for paper in _chosen(only):
        begun = time.monotonic()
        if paper in LOGS and (why := why_missing()):
            warn(f"{paper}: left out, {why}")
            continue
        conclusions = reproduce_part(paper, part) if part else reproduce_paper(paper, Profile.FULL)
        for each in conclusions:
            show(f"{each.id:<4} {each.verdict.label:<15} {first_sentence(each.sentence)}")
        counts = Counter(each.verdict for each in conclusions)
        ruled = ", ".join(
            f"{counts[verdict]} {verdict.label}" for verdict in Verdict if verdict in counts
        )
        lines.append(f"{paper}: {ruled or 'judges no claim'} ({time.monotonic() - begun:.0f} s)")
    page = write_report(results())
    show("\n".join(["", *lines]))
    show(f"{short(page)} has the figures and tables behind them; open it in a browser")


def _check_claims() -> None:
    """Read the tables of claims: a damaged one ends the command before hours are spent."""
    read_claims(results() / "claims.csv")
    read_verdicts(results() / "verdicts.csv")


def renew(only: str | None = None) -> None:
    """Run the studies that have a stale table; of the others, draw and judge what is stale.

    Recordings that have not changed come from the cache.
    """
    _check_claims()
    stale = [each for each in list_built(results()) if each.state is not State.FRESH]
    chosen = {only} if only is not None else {*STUDIES}
    for study in [s for s in STUDIES if s in chosen]:
        own = [
            each
            for each in stale
            if each.study == study and not Path(each.name).stem.endswith(_APART)
        ]
        if not own:
            continue
        if study in LOGS and (why := why_missing()):
            warn(f"{study}: {pluralize(len(own), 'result')} stale, left out: {why}")
            continue
        show(f"{study}: {pluralize(len(own), 'result')} stale")
        if any(each.name.startswith("tables/") for each in own):
            reproduce_paper(study, Profile.FULL)
        else:
            _renew_derived(study, own)
    if stale:
        show(short(write_report(results())))


def _renew_derived(study: str, stale: list[Built]) -> None:
    """Draw a study's figures and judge its claims again, from its tables, whichever is stale."""
    place = results()
    made = Results(place, study)
    with made.blaming_files():
        if any(each.name.startswith("figures/") for each in stale):
            note_built(place, study, _drawn_items(made))
        if any("/" not in each.name for each in stale):
            items, claims, conclusions = _judged_items(made)
            _write(claims, conclusions, place, study, Profile.FULL)
            note_built(place, study, items)


def redraw(only: str | None = None) -> None:
    """Draw the figures again, from the tables and arrays that the studies left.

    Raises
    ------
    InputError
        If there are none, or they are damaged.
    """
    place = results()
    chosen = _chosen(only, (*STUDIES, *SWEEPS))
    present = [p for p in chosen if any((place / "tables").glob(f"{p}_*.csv"))]
    if not present:
        raise InputError(
            f"{short(place / 'tables')}: no tables of {only or 'any paper'}; "
            f"run `{reproduce_command(only)}`"
        )
    for paper in chosen:
        begun = time.monotonic()
        if paper not in present:
            warn(f"{paper}: left out, no tables in {short(place)}")
            continue
        made = Results(place, paper)
        if paper in LOGS and only is None and not any((place / "arrays").glob(f"{paper}_*.npz")):
            warn(f"{paper}: left out, what it draws of the logs is not here")
            continue
        with made.blaming_files():
            note_built(place, paper, _drawn_items(made))
        warn(f"{paper}: {time.monotonic() - begun:.0f} s")


def reproduce_paper(paper: str, profile: Profile) -> list[Conclusion]:
    """Run one paper's study, and put its files, claims, verdicts and origin in place.

    The files are written elsewhere first, so an interrupted run leaves the results as they were;
    run again by the same code, it goes on with the tables of the jobs that it had finished.
    """
    begun, place = time.monotonic(), results()
    aside = results() / "cache"  # which is not committed
    aside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=aside, prefix=f"{paper}-") as name:
        made = Results(Path(name), paper)
        study = _part(paper, "study")
        with progress(paper, 1.0) as on_progress, recorded(study.__name__) as seen:
            code = digest_of_all(seen.digests())
            seen.keep_in = aside / f"unfinished-{paper}-{profile}-{code}"
            if seen.keep_in.exists():
                warn(f"{paper}: goes on with the {_count(seen.keep_in)} that are done")
            study.run(profile, made, on_progress)
        items = table_dependencies(seen, made.folder)
        items |= _drawn_items(made)
        verdicts, claims, conclusions = _judged_items(made)
        for kind in ("tables", "arrays", "figures"):
            _put_in_place(made.folder / kind, place / kind, paper)
        _write(claims, conclusions, place, paper, profile)
        note_provenance(place, paper, profile, time.monotonic() - begun)
        note_built(place, paper, items | verdicts, only_these=True)
    for left in aside.glob(f"unfinished-{paper}-{profile}-*"):
        shutil.rmtree(left, ignore_errors=True)
    return conclusions


def reproduce_part(study: str, name: str) -> list[Conclusion]:
    """Make some of a study's tables again, by its PARTS; draw and judge from all that are there.

    The other tables stay as they are, and so does what results/built.json says of them.
    """
    module, place = _part(study, "study"), results()
    if name not in getattr(module, "PARTS", {}):
        known = ", ".join(getattr(module, "PARTS", {})) or "none"
        raise InputError(f"{study} has no part {name!r} to be made alone; it has {known}")
    made = Results(place, study)
    with progress(f"{study}: {name}", 1.0) as on_progress, recorded(module.__name__) as seen:
        seen.keep_in = (
            place / "cache" / f"unfinished-{study}-{name}-{digest_of_all(seen.digests())}"
        )
        tables = module.PARTS[name](Profile.FULL, on_progress)
        made.write_tables(**tables)
    own = {f"tables/{study}_{table}.csv" for table in tables}
    items = {key: one for key, one in table_dependencies(seen, place).items() if key in own}
    items |= _drawn_items(made)
    verdicts, claims, conclusions = _judged_items(made)
    _write(claims, conclusions, place, study, Profile.FULL)
    note_built(place, study, items | verdicts)
    shutil.rmtree(seen.keep_in, ignore_errors=True)
    return conclusions


def reproduce_over(study: str, folder: Path) -> None:
    """Run a study's methods over a folder of logs; a table and a figure in `results/logs/NAME`.

    Of the logs that the project knows they are the judged ones.

    Raises
    ------
    InputError
        If the study does not run over logs, or the folder or one of its logs is damaged.
    """
    _chosen(study)
    module = _part(study, "study")
    able = [each for each in OWN if hasattr(_part(each, "study"), "over_folder")]
    require(study in able, f"{study} runs over no folder of logs; {' or '.join(able)} does")
    if folder.resolve() == DATA.resolve() and not why_missing():
        reproduce_part(study, "logs")
        show(short(results() / "tables" / f"{study}_logs.csv"))
        return
    made = Results(results() / "logs" / folder.resolve().name, study)
    with progress(f"{study}: {folder.name}", 1.0) as on_progress:
        made.write_tables(**module.over_folder(folder, on_progress))
    _draw(made)
    for path in sorted(made.folder.glob("*/*")):
        show(short(path))


def _count(folder: Path) -> str:
    return pluralize(sum(1 for _ in folder.glob("*.job")), "job")


def _drawn_items(made: Results) -> Items:
    """Draw a study's figures; what each depends on, and the seconds that all took."""
    begun = time.monotonic()
    with recorded(_part(made.paper, "figures").__name__) as seen:
        names = _draw(made)
    found = dependencies_of(seen, made.folder), time.monotonic() - begun
    return {f"figures/{name}.png": found for name in names}


def _judged_items(made: Results) -> tuple[Items, list[Claim], list[Conclusion]]:
    """Judge a study's claims; what each verdict depends on, and the seconds that all took."""
    if made.paper in OWN:
        return {}, [], []
    begun = time.monotonic()
    with recorded(_part(made.paper, "claims").__name__, conclude.__module__) as seen:
        claims, conclusions = judgement(made)
    found = dependencies_of(seen, made.folder), time.monotonic() - begun
    return {each.id: found for each in conclusions}, claims, conclusions


def judgement(made: Results) -> tuple[list[Claim], list[Conclusion]]:
    """Statistics of a paper's claims by its tables, and the one verdict on each claim."""
    part = _part(made.paper, "claims")
    with limit_blas():
        claims = part.judge(made)
        regions = part.regions(made) if hasattr(part, "regions") else {}
    return claims, conclude(claims, findings(made.paper), regions)


def _write(
    claims: list[Claim], conclusions: list[Conclusion], place: Path, paper: str, profile: Profile
) -> None:
    command = reproduce_command(paper)
    write_claims(claims, place / "claims.csv", paper=paper, profile=profile, command=command)
    says = findings(paper)["claims"]
    write_verdicts(conclusions, place / "verdicts.csv", paper=paper, says=says, profile=profile)


def _draw(made: Results) -> list[str]:
    """Draw a study's figures; return their names."""
    with limit_blas():
        pages = _part(made.paper, "figures").draw(made)
    for title, page in pages.items():
        save_figure(page, made.folder / "figures" / f"{title}.png")
    return sorted(pages)


def _put_in_place(new: Path, old: Path, paper: str) -> None:
    """Move a paper's new files over its old ones, and delete the old ones without a new one."""
    made = {path.name for path in new.glob(f"{paper}_*")}
    try:
        old.mkdir(parents=True, exist_ok=True)
        for path in old.glob(f"{paper}_*"):
            if path.name not in made and not path.stem.endswith(_APART):
                path.unlink()
        for name in sorted(made):
            os.replace(new / name, old / name)
    except OSError as error:
        raise InputError(
            f"{error.filename2 or error.filename}: cannot be replaced ({error.strerror}); move it "
            "away and run again"
        ) from error


def _chosen(only: str | None, known: tuple[str, ...] = STUDIES) -> tuple[str, ...]:
    if only in SWEEPS and only not in known:
        raise InputError(f"{only} is a sweep; `estima run -m study={only}` makes it again")
    if only is not None and only not in known:
        raise InputError(f"no paper or study named {only}; {nearest(only, known)}")
    return known if only is None else (only,)


def first_sentence(text: str) -> str:
    """Return the text up to its first full stop that ends a sentence."""
    return re.split(r"(?<=[a-z0-9)%]\.) (?=[A-Z])", text, maxsplit=1)[0]
