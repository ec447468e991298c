"""The tables and figures of Schuchert 2010 measured again, as one page.

``experiment`` says what an experiment is, ``chapter3`` to ``chapter6`` are the experiments, ``measure`` runs them into
records, ``store`` keeps those, ``cells`` puts them beside the printed values, ``plots`` and ``page`` show them.
"""
