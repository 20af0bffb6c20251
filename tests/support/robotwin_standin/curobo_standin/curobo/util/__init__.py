from . import logger as logger
