"""Leave a few of the mutants in a cosmic-ray session, drawn with a seed: draw_mutants.py SESSION COUNT SEED."""

import random
import sqlite3
import sys

session, count, seed = sys.argv[1:]
with sqlite3.connect(session) as db:
    # Without `|`, which is mostly in annotations, and without `is` for `==`, which small integers do not feel.
    mutants = db.execute(
        "SELECT module_path, start_pos_row, start_pos_col, operator_name, occurrence, job_id FROM mutation_specs "
        "WHERE operator_name NOT GLOB '*BitOr*' AND operator_name NOT GLOB '*_Is*' ORDER BY 1, 2, 3, 4, 5"
    ).fetchall()
    random.seed(int(seed))
    random.shuffle(mutants)
    # One for each place: an operator with ten replacements is not drawn ten times as often.
    places = {mutant[:3]: mutant[-1] for mutant in mutants}
    jobs = [places[place] for place in random.sample(sorted(places), min(int(count), len(places)))]
    for table in ("mutation_specs", "work_items"):
        db.execute(f"DELETE FROM {table} WHERE job_id NOT IN ({','.join('?' * len(jobs))})", jobs)
