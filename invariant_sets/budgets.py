"""Budgets of `invariant_sets`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

# --- sizes that doubles, memory and time allow -----------------------------------------------------------------------
CHEAP_HULL_DIM = 4  # Up to so many dimensions vertices and Qhull are quicker than linear programs.
FEW_ROWS = 40  # Removing redundancy from at most so many rows costs more than it saves.
MOST_ROWS = 400_000  # One elimination may have so many rows, about 50 MB.
MOST_HULL_FACETS = 1_000_000  # A hull of more facets, about 1 GB in Qhull, is refused whatever the time.
MOST_SORTING_FACETS = 100_000  # A hull that only sorts out rows before linear programs has at most so many facets, 3 s.
MOST_SUM_TERMS = 5000  # A sum of supports has at most so many terms.
PROGRAMS_PER_CHECK = 50  # So many linear programs are solved between two looks at the clock.
SECONDS_PER_FACET = 3e-5  # Qhull takes so long for a facet [s] on a slow core, degenerate points included.
EXACT_SHARE = 0.8  # The exact recursion has this share of the time limit; the rest is for an inner set.
