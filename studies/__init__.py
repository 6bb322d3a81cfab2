"""Studies that end in a report: the thesis reproduced, controllers, force laws.

``python -m studies thesis|control|truth`` writes a report, ``python -m studies bags`` the thesis'
runs as bags. Nothing that is installed imports this package.
"""
