/* The base drive model in C: the equations of pmac_comp/physics/model/kernel.py for ideal Coulomb
 * friction, load-dependent nut friction, current loop, delay and PID. The yardstick of
 * tools/bench_model.py, compiled there with -O3; step matrices come from the caller. */
#include <math.h>
#include <string.h>

enum { NS = 8, NC = 13, HISTORY = 256 };

/* Order of the parameters handed over; see PARAMETERS in bench_model.py. */
enum {
    PERIOD, LEAD, ORIGIN, RATE, DELAY, LIMIT, ACT_LIMIT, K_NUT, NUT_LOAD,
    L_MOTOR, L_NUT, L_GUIDE, KP, KI, KD, KVFF, KAFF, FRICTION_FF, OFFSET, I_LIMIT
};

static double clamp(double value, double limit) {
    return value > limit ? limit : (value < -limit ? -limit : value);
}

static double coulomb(double change, double speed, double level, double push) {
    double hold = change / push;
    double sign = speed > 0.0 ? 1.0 : -1.0;
    if (speed == 0.0) return clamp(hold, level);
    double last = speed + change - push * sign * level;
    if (last * sign >= 0.0) return sign * level;
    double share = speed / (speed - last);
    return share * sign * level + (1.0 - share) * clamp(hold, level);
}

int run(const double *p, const double *bank, int n_nodes, double first, double spacing, int n_sub,
        const double *desired, const double *ff, const double *external, int n, double *out) {
    static const int rows[3] = {0, 1, 3};
    static const int columns[3] = {8, 10, 11};
    double Ts = p[PERIOD], h = Ts / n_sub, rho = p[LEAD];
    double fade = exp(-p[RATE] * h), delay_steps = p[DELAY] / h;
    double W[NC][NS], z[NS] = {0}, zf[NS], history[HISTORY] = {0};
    double mean[3] = {0}, moved[3], gained[3], start[3];
    double motor_torque = 0.0, integral = 0.0, old_vc = 0.0, old_desired = desired[0];
    z[0] = z[1] = desired[0] / rho;
    z[3] = desired[0];
    double old_read = rho * z[0];
    for (int k = 0; k < n; k++) {
        double read = rho * z[0], error = desired[k] - read;
        double vc = (desired[k] - old_desired) / Ts, ac = (vc - old_vc) / Ts;
        double v = (read - old_read) / Ts;
        double u = p[KP] * error + integral + p[KVFF] * vc + p[KAFF] * ac - p[KD] * v;
        if (fabs(desired[k] - old_desired) > 1e-11) u += copysign(p[FRICTION_FF], vc);
        u += p[OFFSET] + ff[k];
        double command = clamp(u, p[LIMIT]);
        if (u == command) integral = clamp(integral + p[KI] * Ts * error, p[I_LIMIT]);
        old_read = read;
        old_desired = desired[k];
        old_vc = vc;
        history[k % HISTORY] = clamp(command, p[ACT_LIMIT]);
        out[k] = read;
        out[n + k] = z[3];
        out[2 * n + k] = command;
        out[3 * n + k] = motor_torque;
        out[4 * n + k] = p[K_NUT] * (z[3] - rho * z[1] - z[2]);
        if (!(fabs(z[3]) < 1e6 && fabs(z[4]) < 1e9)) return k;

        double place = (z[3] + p[ORIGIN] - first) / spacing;
        if (!(place > 0.0)) place = 0.0;
        if (place > n_nodes - 1) place = n_nodes - 1;
        int node = (int)place < n_nodes - 2 ? (int)place : n_nodes - 2;
        double w = place - node;
        const double *one = bank + node * NS * NC, *two = one + NS * NC;
        for (int i = 0; i < NC; i++)
            for (int j = 0; j < NS; j++)
                W[i][j] = one[i * NS + j] + w * (two[i * NS + j] - one[i * NS + j]);

        for (int sub = 0; sub < n_sub; sub++) {
            double late = k * n_sub + sub - delay_steps;
            int cell = (int)floor(late / n_sub);
            double to_next = (cell + 1.0) * n_sub - late;
            double held = cell >= 0 ? history[cell % HISTORY] : 0.0;
            if (to_next < 1.0) {
                double next = cell + 1 >= 0 ? history[(cell + 1) % HISTORY] : 0.0;
                held = to_next * held + (1.0 - to_next) * next;
            }
            double fading = motor_torque - held, push = -external[k];
            for (int i = 0; i < NS; i++)
                zf[i] = W[8][i] * held + W[9][i] * fading + W[11][i] * push;
            for (int j = 0; j < NS; j++)
                for (int i = 0; i < NS; i++) zf[i] += W[j][i] * z[j];
            double delta = 0.5 * (z[3] + zf[3] - rho * (z[1] + zf[1]) - z[2] - zf[2]);
            for (int i = 0; i < 3; i++) {
                const double *c = W[columns[i]];
                delta -= 0.5 * (c[3] - rho * c[1] - c[2]) * mean[i];
            }
            double level[3] = {p[L_MOTOR], 0.0, p[L_GUIDE]};
            level[1] = p[L_NUT] + p[NUT_LOAD] * rho * fabs(p[K_NUT] * delta);
            for (int i = 0; i < 3; i++) {
                int row = rows[i];
                moved[i] = zf[row] - z[row];
                gained[i] = zf[4 + row] - z[4 + row];
                start[i] = z[4 + row];
                for (int j = 0; j < 3; j++) {
                    moved[i] -= W[columns[j]][row] * mean[j];
                    gained[i] -= W[columns[j]][4 + row] * mean[j];
                }
            }
            for (int sweep = 0; sweep < 4; sweep++) {
                double largest = 0.0;
                for (int i = 0; i < 3; i++) {
                    double old = mean[i], slope = W[columns[i]][4 + rows[i]], new = 0.0;
                    if (level[i] > 0.0)
                        new = coulomb(gained[i] + slope * old, start[i], level[i], slope);
                    double step = new - old;
                    if (step == 0.0) continue;
                    mean[i] = new;
                    double over = fabs(step) - 1e-6 * level[i];
                    if (over > largest) largest = over;
                    for (int j = 0; j < 3; j++) {
                        moved[j] -= W[columns[i]][rows[j]] * step;
                        gained[j] -= W[columns[i]][4 + rows[j]] * step;
                    }
                }
                if (largest <= 0.0) break;
            }
            for (int i = 0; i < NS; i++)
                z[i] = zf[i] - W[8][i] * mean[0] - W[10][i] * mean[1] - W[11][i] * mean[2];
            motor_torque = held + fade * fading;
        }
    }
    return n;
}
