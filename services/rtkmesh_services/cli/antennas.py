"""``rtkmesh antennas``: where the antennas of a vehicle are, and where they ought to be."""

from cyclopts import App

from rtkmesh_services.cli.antennas_calibrate import EXAMPLES as CALIBRATE
from rtkmesh_services.cli.antennas_calibrate import calibrate
from rtkmesh_services.cli.antennas_design import EXAMPLES as DESIGN
from rtkmesh_services.cli.antennas_design import design
from rtkmesh_services.cli.page import command_page

app = App(name="antennas", help="Layouts of antennas: calibrate one that is there, design one that is planned.")
app.command(command_page(calibrate, CALIBRATE))
app.command(command_page(design, DESIGN))
