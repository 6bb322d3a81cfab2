"""Studies that produce a report: reproduction of the thesis, controllers, force laws.

``python -m studies thesis|control|truth`` writes a report, and ``python -m studies bags`` writes
the runs of the thesis as bags. No installed module imports this package.
"""
