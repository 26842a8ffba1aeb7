"""FITS keywords and tables that approximate the WCS of a calibration, and their deviation.

::

    Calibration --make_form--> FitsForm (keywords, tables, deviation)
"""

from wpdc_gwcs.export.cards import FORMAT_VERSION, add_history, frame_cards, number_card
from wpdc_gwcs.export.exact import deviation, image_shape_of
from wpdc_gwcs.export.forms import FORMS, FitsForm, make_form
from wpdc_gwcs.export.own import INSTRUMENT_NAME, TABLE_COLUMNS, TABLE_NAME, own_tables
from wpdc_gwcs.export.tab import TAB_NAME
from wpdc_gwcs.export.tpv import fold_polynomial

__all__ = [
    "FORMAT_VERSION",
    "FORMS",
    "INSTRUMENT_NAME",
    "TABLE_COLUMNS",
    "TABLE_NAME",
    "TAB_NAME",
    "FitsForm",
    "add_history",
    "deviation",
    "fold_polynomial",
    "frame_cards",
    "image_shape_of",
    "make_form",
    "number_card",
    "own_tables",
]
