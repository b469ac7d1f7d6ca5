"""Ten masses in a row, 20 states: the largest study."""

from ccdtools.studies.cases._chains import chain_study

study = chain_study("mass_chain_10", "Chain of ten masses", 10)
