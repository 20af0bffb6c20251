def setup_logger(level="info", logger_name="curobo"):
    pass
