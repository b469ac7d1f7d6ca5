"""Four masses in a row; stiffness and damping are the design."""

from ccdtools.studies.cases._chains import chain_study

study = chain_study("mass_chain", "Chain of four masses", 4)
