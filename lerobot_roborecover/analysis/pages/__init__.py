"""HTML pages and what lies beside them: templates, style sheet, scripts, images and videos."""
