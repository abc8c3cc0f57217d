/* The yardstick of `gough bench --only kinematics`: direct kinematics from leg lengths as in LinuxCNC's genhexkins, written anew
 * from its description. Newton's iteration on x, y, z, roll, pitch and yaw: the inverse kinematics at the pose give the errors of
 * the lengths and the Jacobian, which is inverted whole, by Gauss-Jordan elimination. The turn takes its steps as if the
 * angles were a rotation vector. It ends when no length was off by more than the tolerance before the last step.
 */
#include <math.h>

enum { LEGS = 6, MOST_STEPS = 100 };

static const double LEAST_PIVOT = 0.01; /* a smaller one is exchanged for one below it */

static void rotation_of(const double *rpy, double rotation[3][3])
{
    double sr = sin(rpy[0]), cr = cos(rpy[0]), sp = sin(rpy[1]), cp = cos(rpy[1]), sy = sin(rpy[2]), cy = cos(rpy[2]);

    rotation[0][0] = cp * cy;
    rotation[1][0] = cp * sy;
    rotation[2][0] = -sp;
    rotation[0][1] = sr * sp * cy - cr * sy;
    rotation[1][1] = sr * sp * sy + cr * cy;
    rotation[2][1] = sr * cp;
    rotation[0][2] = cr * sp * cy + sr * sy;
    rotation[1][2] = cr * sp * sy - sr * cy;
    rotation[2][2] = cr * cp;
}

static int invert(double matrix[LEGS][LEGS], double inverse[LEGS][LEGS])
{
    double wide[LEGS][2 * LEGS];

    for (int i = 0; i < LEGS; i++)
        for (int j = 0; j < LEGS; j++) {
            wide[i][j] = matrix[i][j];
            wide[i][LEGS + j] = i == j ? 1.0 : 0.0;
        }
    for (int k = 0; k < LEGS; k++) {
        for (int i = k + 1; fabs(wide[k][k]) < LEAST_PIVOT && i < LEGS; i++)
            if (fabs(wide[i][k]) >= LEAST_PIVOT)
                for (int j = 0; j < 2 * LEGS; j++) {
                    double kept = wide[k][j];
                    wide[k][j] = wide[i][j];
                    wide[i][j] = kept;
                }
        if (wide[k][k] == 0.0)
            return -1;
        for (int i = k + 1; i < LEGS; i++) {
            double factor = wide[i][k] / wide[k][k];
            for (int j = 0; j < 2 * LEGS; j++)
                wide[i][j] -= factor * wide[k][j];
        }
    }
    for (int k = 0; k < LEGS; k++) {
        double pivot = wide[k][k];
        for (int j = k; j < 2 * LEGS; j++)
            wide[k][j] /= pivot;
    }
    for (int k = LEGS - 1; k > 0; k--)
        for (int i = k - 1; i >= 0; i--) {
            double factor = wide[i][k];
            for (int j = k; j < 2 * LEGS; j++)
                wide[i][j] -= factor * wide[k][j];
        }
    for (int i = 0; i < LEGS; i++)
        for (int j = 0; j < LEGS; j++)
            inverse[i][j] = wide[i][LEGS + j];
    return 0;
}

static int find_pose(double base[LEGS][3], double platform[LEGS][3], const double *lengths, double tolerance, double *pose)
{
    for (int step = 1; step <= MOST_STEPS; step++) {
        double rotation[3][3], jacobian[LEGS][LEGS], inverse[LEGS][LEGS], errors[LEGS], worst = 0.0;

        rotation_of(pose + 3, rotation);
        for (int k = 0; k < LEGS; k++) {
            double arm[3], leg[3], length;

            for (int i = 0; i < 3; i++) {
                arm[i] = rotation[i][0] * platform[k][0] + rotation[i][1] * platform[k][1] + rotation[i][2] * platform[k][2];
                leg[i] = pose[i] + arm[i] - base[k][i];
            }
            length = sqrt(leg[0] * leg[0] + leg[1] * leg[1] + leg[2] * leg[2]);
            for (int i = 0; i < 3; i++)
                jacobian[k][i] = leg[i] / length;
            jacobian[k][3] = arm[1] * jacobian[k][2] - arm[2] * jacobian[k][1];
            jacobian[k][4] = arm[2] * jacobian[k][0] - arm[0] * jacobian[k][2];
            jacobian[k][5] = arm[0] * jacobian[k][1] - arm[1] * jacobian[k][0];
            errors[k] = length - lengths[k];
            worst = fmax(worst, fabs(errors[k]));
        }
        if (invert(jacobian, inverse) != 0)
            return -1;
        for (int i = 0; i < LEGS; i++)
            for (int k = 0; k < LEGS; k++)
                pose[i] -= inverse[i][k] * errors[k];
        if (worst <= tolerance)
            return step;
    }
    return -1;
}

/* Find the poses (x, y, z, roll, pitch, yaw) of `rows` sets of lengths, each from the pose before; the first one from `pose`.
 * Returns the number of steps in all, -1 if a pose was not found.
 */
long follow_lengths(
    double base[LEGS][3], double platform[LEGS][3], double lengths[][LEGS], long rows, double tolerance, double *pose,
    double poses[][LEGS])
{
    long steps = 0;

    for (long row = 0; row < rows; row++) {
        int taken = find_pose(base, platform, lengths[row], tolerance, pose);

        if (taken < 0)
            return -1;
        steps += taken;
        for (int i = 0; i < LEGS; i++)
            poses[row][i] = pose[i];
    }
    return steps;
}
