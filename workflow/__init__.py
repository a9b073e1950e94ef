"""Run notebooks into results/<id>/ with papermill: only what is out of date, two at once."""
