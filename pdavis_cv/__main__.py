"""``python -m pdavis_cv`` is ``pdavis``."""
from pdavis_cv.tools.main import main

raise SystemExit(main())
