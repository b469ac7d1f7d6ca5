"""Classical problems as rockit and dymos state them; run by `bench_optimal_control.py --peer-python` elsewhere.

Prints one line of JSON: package → problem → seconds (from the statement to the solution, median; of dymos one run),
cost, and lines of the statement. It knows nothing of this project. rockit holds inputs over every interval.
"""

import contextlib
import inspect
import io
import json
import statistics
import sys
import time
import warnings

import numpy as np

INF = float("inf")
IPOPT = {"ipopt.tol": 1e-8, "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "expand": True}


def rockit_problems(N):
    """Functions that state and solve each problem with rockit."""
    from casadi import cos, pi, sin
    from rockit import DirectCollocation, FreeTime, Ocp

    def solved(ocp):
        ocp.solver("ipopt", IPOPT)
        ocp.method(DirectCollocation(N=N, M=1, degree=3, scheme="radau"))
        return float(ocp.solve().value(ocp.objective))

    def bryson_denham():
        ocp = Ocp(T=1.0)
        x, v = ocp.state(), ocp.state()
        u = ocp.control()
        ocp.set_der(x, v)
        ocp.set_der(v, u)
        ocp.add_objective(ocp.integral(u**2 / 2))
        ocp.subject_to(ocp.at_t0(x) == 0)
        ocp.subject_to(ocp.at_t0(v) == 1)
        ocp.subject_to(ocp.at_tf(x) == 0)
        ocp.subject_to(ocp.at_tf(v) == -1)
        ocp.subject_to(x <= 1 / 9)
        return solved(ocp)

    def brachistochrone():
        ocp = Ocp(T=FreeTime(1.0))
        x, y, v = ocp.state(), ocp.state(), ocp.state()
        a = ocp.control()
        ocp.set_der(x, v * sin(a))
        ocp.set_der(y, v * cos(a))
        ocp.set_der(v, 9.81 * cos(a))
        ocp.add_objective(ocp.T)
        for state in (x, y, v):
            ocp.subject_to(ocp.at_t0(state) == 0)
        ocp.subject_to(ocp.at_tf(x) == 10)
        ocp.subject_to(ocp.at_tf(y) == 5)
        ocp.subject_to((0 <= a) <= pi)  # noqa: SIM300
        ocp.subject_to((0.1 <= ocp.T) <= 10)  # noqa: SIM300
        ocp.set_initial(x, 10 * ocp.t)
        ocp.set_initial(y, 5 * ocp.t)
        return solved(ocp)

    def van_der_pol():
        ocp = Ocp(T=5.0)
        x, v = ocp.state(), ocp.state()
        u = ocp.control()
        ocp.set_der(x, v)
        ocp.set_der(v, -x + v * (1 - x**2) + u)
        ocp.add_objective(ocp.integral(x**2 + v**2 + u**2))
        ocp.subject_to(ocp.at_t0(x) == 1)
        ocp.subject_to(ocp.at_t0(v) == 0)
        ocp.subject_to(v >= -0.4)
        return solved(ocp)

    def shortest_time():
        ocp = Ocp(T=FreeTime(10.0))
        x, v = ocp.state(), ocp.state()
        u = ocp.control()
        ocp.set_der(x, v)
        ocp.set_der(v, u)
        ocp.add_objective(ocp.T)
        for state, value in ((x, 300), (v, 0)):
            ocp.subject_to(ocp.at_t0(state) == 0)
            ocp.subject_to(ocp.at_tf(state) == value)
        ocp.subject_to((-2 <= u) <= 1)  # noqa: SIM300
        ocp.subject_to((1 <= ocp.T) <= 100)  # noqa: SIM300
        return solved(ocp)

    def batch_reactor():
        ocp = Ocp(T=1.0)
        a, b = ocp.state(), ocp.state()
        u = ocp.control()
        ocp.set_der(a, -u * a - u**2 / 2 * a)
        ocp.set_der(b, u * a)
        ocp.add_objective(ocp.at_tf(-b))
        ocp.subject_to(ocp.at_t0(a) == 1)
        ocp.subject_to(ocp.at_t0(b) == 0)
        ocp.subject_to((0 <= u) <= 5)  # noqa: SIM300
        ocp.set_initial(a, 1.0)
        return solved(ocp)

    return {
        "Bryson-Denham": bryson_denham, "brachistochrone": brachistochrone, "Van der Pol with a bound": van_der_pol,
        "shortest time": shortest_time, "batch reactor": batch_reactor,
    }  # fmt: skip


def dymos_problems(N):
    """Functions that state and solve each problem with dymos; its optimiser is SciPy's SLSQP, which comes with it."""
    import dymos
    import openmdao.api as om

    def solved(inputs, rates, states, controls, duration, objective, sign=1.0):
        class Rates(om.ExplicitComponent):
            def initialize(self):
                self.options.declare("num_nodes", types=int)

            def setup(self):
                n = self.options["num_nodes"]
                for name in inputs:
                    self.add_input(name, shape=n)
                for name in rates:
                    self.add_output(name, shape=n)
                self.declare_coloring(wrt="*", method="cs")
                self.declare_partials("*", "*", method="cs")

            def compute(self, given, outputs):
                for name, function in rates.items():
                    outputs[name] = function(*(given[i] for i in inputs))

        problem = om.Problem()
        problem.driver = om.ScipyOptimizeDriver(optimizer="SLSQP", tol=1e-8, maxiter=1000)
        problem.driver.declare_coloring()
        problem.driver.options["disp"] = False
        trajectory = dymos.Trajectory()
        phase = dymos.Phase(ode_class=Rates, transcription=dymos.Radau(num_segments=N, order=3))
        trajectory.add_phase("phase", phase)
        problem.model.add_subsystem("trajectory", trajectory)
        phase.set_time_options(fix_initial=True, **duration)
        for name, (options, _) in states.items():
            phase.add_state(name, targets=[name] if name in inputs else None, **options)
        for name, options in controls.items():
            phase.add_control(name, targets=[name], continuity=False, rate_continuity=False, **options)
        phase.add_objective(objective, loc="final", ref=sign)
        problem.setup()
        phase.set_time_val(initial=0.0, duration=duration.get("duration_val", 1.0))
        for name, (_, ends) in states.items():
            phase.set_state_val(name, ends)
        for name in controls:
            phase.set_control_val(name, [0.5, 0.5])
        dymos.run_problem(problem, run_driver=True, simulate=False, make_plots=False)
        path = "trajectory.phase.t" if objective == "time" else f"trajectory.phase.timeseries.{objective}"
        return sign * float(np.ravel(problem.get_val(path))[-1])

    ends = {"fix_initial": True, "fix_final": True}
    begin = {"fix_initial": True}

    def bryson_denham():
        return solved(
            ("v", "u"), {"x_dot": lambda v, u: v, "v_dot": lambda v, u: u, "J_dot": lambda v, u: u**2 / 2},
            {"x": ({"rate_source": "x_dot", "upper": 1 / 9, **ends}, [0, 0]),
             "v": ({"rate_source": "v_dot", **ends}, [1, -1]), "J": ({"rate_source": "J_dot", **begin}, [0, 4])},
            {"u": {}}, {"fix_duration": True, "duration_val": 1.0}, "J",
        )  # fmt: skip

    def van_der_pol():
        return solved(
            ("x", "v", "u"),
            {"x_dot": lambda x, v, u: v, "v_dot": lambda x, v, u: -x + v * (1 - x**2) + u,
             "J_dot": lambda x, v, u: x**2 + v**2 + u**2},
            {"x": ({"rate_source": "x_dot", **begin}, [1, 0]),
             "v": ({"rate_source": "v_dot", "lower": -0.4, **begin}, [0, 0]),
             "J": ({"rate_source": "J_dot", **begin}, [0, 3])},
            {"u": {}}, {"fix_duration": True, "duration_val": 5.0}, "J",
        )  # fmt: skip

    def shortest_time():
        return solved(
            ("v", "u"), {"x_dot": lambda v, u: v, "v_dot": lambda v, u: u},
            {"x": ({"rate_source": "x_dot", **ends}, [0, 300]), "v": ({"rate_source": "v_dot", **ends}, [0, 0])},
            {"u": {"lower": -2, "upper": 1}}, {"duration_bounds": (1, 100), "duration_val": 10.0}, "time",
        )  # fmt: skip

    def batch_reactor():
        return solved(
            ("a", "u"), {"a_dot": lambda a, u: -u * a - u**2 / 2 * a, "b_dot": lambda a, u: u * a},
            {"a": ({"rate_source": "a_dot", **begin}, [1, 1]), "b": ({"rate_source": "b_dot", **begin}, [0, 0])},
            {"u": {"lower": 0, "upper": 5}}, {"fix_duration": True, "duration_val": 1.0}, "b", -1.0,
        )  # fmt: skip

    return {
        "Bryson-Denham": bryson_denham, "Van der Pol with a bound": van_der_pol, "shortest time": shortest_time,
        "batch reactor": batch_reactor,
    }  # fmt: skip


def main():
    """Run both packages."""
    warnings.simplefilter("ignore")
    N, repeats = int(sys.argv[1]), int(sys.argv[2])
    found = {}
    for package, problems, times in (("rockit", rockit_problems, repeats), ("dymos", dymos_problems, 1)):
        found[package] = {}
        for name, run in problems(N).items():
            seconds, cost = [], None
            for _ in range(times):
                with contextlib.redirect_stdout(io.StringIO()):
                    began = time.perf_counter()
                    try:
                        cost = run()
                    except Exception as error:
                        print(f"{package} {name}: {error}", file=sys.stderr)
                        break
                    seconds.append(time.perf_counter() - began)
            # without def and return; those of dymos use a helper as well and say nothing
            lines = len(inspect.getsource(run).splitlines()) - 2 if package == "rockit" else "–"
            median = statistics.median(seconds) if seconds else None
            found[package][name] = {"seconds": median, "cost": cost, "lines": lines}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
