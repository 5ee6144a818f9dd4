/* udp.c: the controller as a process that communicates by UDP, for software in the loop. Usage: ./udp PORT
 * A datagram has the members of ptsmc_in as doubles, in the order of controller.json; an empty one begins a run. The
 * answer has the status and the members of ptsmc_out, as doubles. The socket accepts programs on this machine only.
 */
#include <arpa/inet.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

#include "ptsmc_${name}_flat.h"

int main(int count, char **given)
{
    const int port = socket(AF_INET, SOCK_DGRAM, 0);
    struct sockaddr_in here = {0}, from;
    double v[PTSMC_IN_SIZE + 1], answer[1 + PTSMC_OUT_SIZE];
    ptsmc_state state;
    ptsmc_in in;
    ptsmc_out out;

    here.sin_family = AF_INET;
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    here.sin_port = htons((unsigned short)atoi(count > 1 ? given[1] : "5005"));
    if (port < 0 || bind(port, (struct sockaddr *)&here, sizeof here) != 0) {
        perror("udp");
        return 1;
    }
    ptsmc_init(&ptsmc_parameters, &state);
    for (;;) {
        socklen_t size = sizeof from;
        const long got = (long)recvfrom(port, v, sizeof v, 0, (struct sockaddr *)&from, &size);

        memset(answer, 0, sizeof answer);
        if (got == 0) {
            ptsmc_init(&ptsmc_parameters, &state);
        } else if (got == PTSMC_IN_SIZE * (long)sizeof(double)) {
            ptsmc_in_from(v, &in);
            answer[0] = ptsmc_step(&ptsmc_parameters, &state, &in, &out);
            ptsmc_out_to(&out, answer + 1);
        } else {
            continue; /* not a message for this program */
        }
        sendto(port, answer, sizeof answer, 0, (struct sockaddr *)&from, size);
    }
}
